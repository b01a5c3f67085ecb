"""Pre-grasps from tele-operated demonstrations."""
