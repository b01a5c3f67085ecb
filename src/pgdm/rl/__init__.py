"""Learning: collect, learn, evaluate, checkpoint; knows neither MuJoCo nor methods."""
