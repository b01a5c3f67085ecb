"""Hands, objects, table scene and motions from the package ``robohive``."""
