"""``pgdm author``."""
