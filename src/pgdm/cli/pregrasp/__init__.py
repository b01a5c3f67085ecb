"""``pgdm pregrasp``."""
