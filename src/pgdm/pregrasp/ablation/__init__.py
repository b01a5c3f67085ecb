"""Ablations of a start state: open hand, mean hand, greater distance."""
