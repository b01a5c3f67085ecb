"""Pre-grasps, in which episodes start: obtained, checked, reached and ablated."""
