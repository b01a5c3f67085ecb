"""Exemplar motions."""
