"""Expert hand trajectories: rebuilding unpublished ones, measuring all, filling the library."""
