"""Paths and plans of the hand's base with which the hand follows an exemplar motion."""
