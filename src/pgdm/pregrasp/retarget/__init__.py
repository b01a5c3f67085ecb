"""From a human hand's motion to the pre-grasp of a robot hand."""
