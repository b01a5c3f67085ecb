"""``hydra/sweeper=pgdm``: a thin shell around ``pgdm.sweep.expand``."""
