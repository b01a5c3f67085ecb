"""The reach: the planned motion from the reset pose to a pre-grasp (paper, App. B)."""

from pgdm.pregrasp.reach.planner import plan_reach

__all__ = ["plan_reach"]
