"""Pre-grasps posed by a person on a page in the browser."""
