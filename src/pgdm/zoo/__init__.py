"""The zoo: policies of finished studies, with their wrist plans, settings and results."""

from pgdm.zoo.place import Entry, Zoo

__all__ = ["Entry", "Zoo"]
