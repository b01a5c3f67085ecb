"""Playback of a trained policy on a robot arm: converted, checked, simulated and played."""
