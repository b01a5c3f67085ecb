"""The command lines ``pgdm-run`` and ``pgdm``."""
