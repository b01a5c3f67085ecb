"""The commands ``pgdm pregrasp ...``."""
