"""Expert hand trajectories: read, rebuilt where unpublished, and indexed."""
