"""Hands, objects, scenes and motions from the package ``robohive``."""
