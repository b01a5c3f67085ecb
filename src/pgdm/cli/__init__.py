"""What people type: ``pgdm-run`` and ``pgdm``."""
