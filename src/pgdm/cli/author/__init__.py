"""The commands ``pgdm author ...``."""
