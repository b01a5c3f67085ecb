"""Retargeting: the pre-grasp of a robot hand from recorded joints of a human hand."""
