"""Wrist paths and wrist plans: base joint positions that let the hand follow a motion."""
