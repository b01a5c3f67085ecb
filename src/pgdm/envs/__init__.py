"""The MDP over a batch of simulations, and its interfaces: batch, Gymnasium, TorchRL, SB3."""
