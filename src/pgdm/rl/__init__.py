"""Learning: collect, learn, evaluate, save; depends on neither MuJoCo nor the methods."""
