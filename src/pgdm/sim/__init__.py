"""Scenes, batches of simulations, pictures."""
