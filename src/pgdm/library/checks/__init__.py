"""Checks of models and motions, and comparisons between library sources."""
