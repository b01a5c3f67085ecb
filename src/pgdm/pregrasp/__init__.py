"""Pre-grasps: where an episode starts."""
