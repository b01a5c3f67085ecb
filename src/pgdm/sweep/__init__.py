"""Sweeps: many runs planned, driven and monitored as one."""
