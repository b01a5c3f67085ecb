"""The settings, inside an installed package: Hydra finds them as pkg://pgdm.conf."""
