"""An ablated start: what became of a pre-grasp from which something was taken away."""

from __future__ import annotations

from dataclasses import dataclass

from pgdm.pregrasp.sources import StartState

FINGER_LENGTH_M = 0.1
"""Turns a finger's error into one of its tip, to weigh it against a retreat of the wrist."""
_SHORT_M = 0.001
"""A distance that is this far from what was asked for is told."""


@dataclass(frozen=True)
class Ablated:
    """An ablated start, and how far it is from what the ablation asks for."""

    start: StartState
    distance_m: float
    """How far the wrist is from its place in the pre-grasp."""
    retreat_m: float
    """What of it the ablation did not ask for: room that the hand needed."""
    finger_error_rad: float
    """Largest difference of a finger joint from the pose that was asked for."""
    object_moved_m: float
    """How far the object was pushed while the fingers moved in the simulation; it was put back."""
    simulated: bool
    """Whether the fingers were moved there in the simulation, or just set."""
    depth_m: float
    """Deepest penetration of the hand and anything else."""

    @property
    def deviation_m(self) -> float:
        """Retreat of the wrist, and the fingers' error at their tips."""
        return self.retreat_m + FINGER_LENGTH_M * self.finger_error_rad

    def facts(self) -> dict[str, str]:
        """Return what a run should tell of it."""
        return {
            "ablation_distance_mm": f"{1e3 * self.distance_m:.1f}",
            "ablation_retreat_mm": f"{1e3 * self.retreat_m:.1f}",
            "ablation_finger_error_rad": f"{self.finger_error_rad:.3f}",
            "ablation_depth_mm": f"{1e3 * self.depth_m:.1f}",
            "ablation_reached_by": "simulation" if self.simulated else "setting",
        }

    def compromises(self, asked_m: float) -> str:
        """Return in words what is not as asked for; empty if all is.

        Args:
            asked_m: the distance that the ablation asks for.
        """
        parts = []
        if self.retreat_m > 0:
            parts.append(f"the wrist retreats {1e2 * self.retreat_m:.1f} cm to touch nothing")
        if self.finger_error_rad > 0:
            parts.append(f"fingers stop {self.finger_error_rad:.2f} rad short of their pose")
        if self.distance_m < asked_m - _SHORT_M:
            parts.append(
                f"a slide ends {1e2 * self.distance_m:.1f} cm away, not {1e2 * asked_m:.1f}"
            )
        return ", ".join(parts)
