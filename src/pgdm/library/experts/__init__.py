"""Expert hand trajectories: rebuilding unpublished ones, measuring, and filling the library."""
