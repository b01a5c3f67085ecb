"""The commands ``pgdm deploy ...``."""
