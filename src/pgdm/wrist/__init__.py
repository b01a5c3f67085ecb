"""Wrist paths and wrist plans: targets of the base joints that let the hand follow a motion."""
