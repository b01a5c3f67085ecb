"""Targets for the points of a robot hand that is to follow a human hand.

Each bone keeps its direction in the human hand and gets the robot's length. The bones are chained
from an anchor, which stays in place: outwards from the wrist, or inwards from the fingers' pads
(middles of their last bones).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from pgdm.errors import ConfigError, amount, check_name
from pgdm.pregrasp.retarget.keypoints import FINGERS, Keypoints, filled, palm_axes
from pgdm.sim.scene import Scene

ANCHORS = ("wrist", "pads")
"""The points that stay where the human hand has them: the wrist, as in the published trajectories,
or the fingers' pads, for robot hands whose size differs from the human hand's."""

LIKE_A_PERSON = 0.8, 1.35
"""The two hands count as about equal in size if the robot hand's length, divided by the human
hand's, is in this range."""

_WEIGHTS = {"wrist": (0.6, 0.6, 0.6, 1.0), "pads": (0.05, 0.05, 0.1, 1.0)}
"""Weights of wrist, knuckles, middle points and distal points (the fingertips), 1/m, by anchor."""
_PALM_WEIGHT = {"wrist": 0.0, "pads": 0.02}
"""Weight of the palm's orientation, 1/rad, by anchor."""
_ACROSS = ("index", "middle", "ring", "little")
_LAST_M = 0.01
"""Distance from a finger's distal joint to the middle of its last bone."""


@dataclass(frozen=True)
class Targets:
    """Targets of inverse kinematics, world frame."""

    points: np.ndarray = field(repr=False)
    """Target positions of the hand's tracked points (P, 3) m."""
    weights: np.ndarray = field(repr=False)
    """Weights of the points (P,), 1/m; 0 leaves a point free."""
    palm: np.ndarray = field(repr=False)
    """Target orientation of the palm (3, 3), axes as in
    :func:`pgdm.pregrasp.retarget.keypoints.palm_axes`."""
    palm_weight: float
    """Weight of the palm's orientation, 1/rad."""
    scale: float
    """Length of the robot hand divided by that of the human hand."""
    anchor: str
    """One of :data:`ANCHORS`."""


class HandShape:
    """The tracked points of a scene's hand, by finger, and the bones between them.

    Args:
        scene: scene with the hand.

    Raises:
        ConfigError: the hand's points are not the wrist, then knuckle, middle and distal point of
            each finger, or its ``human_fingers`` do not fit its fingertips.
    """

    def __init__(self, scene: Scene) -> None:
        hand, model = scene.hand, scene.model
        self.fingers = tuple(hand.human_fingers)
        """Human finger that each robot finger follows, in the order of the hand's fingertips."""
        _check(hand.name, self.fingers, hand.fingertips, len(hand.points))
        self.rows = np.array([[tip - 2, tip - 1, tip] for tip in hand.fingertips])
        """Indices of each finger's knuckle, middle and distal point among the points (F, 3)."""
        self.first_finger_joint = hand.num_base_joints + hand.num_wrist_joints
        self.palm_body = int(model.jnt_bodyid[self.first_finger_joint - 1])
        """Id of the body that the last joint before the fingers moves."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        rest = data.geom_xpos[scene.index.point_geoms]
        rotation = data.xmat[self.palm_body].reshape(3, 3)
        self._across = [i for i, name in enumerate(self.fingers) if name != "thumb"]
        self._across.sort(key=lambda i: _ACROSS.index(self.fingers[i]))
        self.lengths = np.linalg.norm(
            np.diff(np.insert(rest[self.rows], 0, rest[0], axis=1), axis=1), axis=-1
        )
        """Lengths (F, 3) m of each finger's bones: wrist to knuckle, knuckle to middle point,
        middle to distal point."""
        axes = palm_axes(rest[0], rest[self.rows[self._across, 0]])
        self.palm_in_body = rotation.T @ axes
        """The palm's axes in the frame of the palm's body (3, 3)."""
        self._rest, self._axes = rest, axes

    @property
    def span_m(self) -> float:
        """Largest distance from the wrist to a distal point along the bones."""
        return float(self.lengths.sum(axis=1).max())

    def keypoints(self, points: np.ndarray) -> Keypoints:
        """Return a human hand whose joints are at the robot hand's points (P, 3) m."""
        known = {}
        for name, (knuckle, middle, distal) in zip(self.fingers, points[self.rows], strict=True):
            last = distal - middle
            last = _LAST_M * last / max(float(np.linalg.norm(last)), 1e-9)
            known[name] = np.stack((knuckle, middle, distal - last, distal + last))
        return filled(points[0], known)

    def targets(self, human: Keypoints, anchor: str | None = None) -> Targets:
        """Return the targets with which the robot hand follows a human hand.

        Args:
            human: the human hand.
            anchor: one of :data:`ANCHORS`; by default the wrist if all five fingers were measured
                and the hands have about the same size, else the pads.
        """
        scale = self.span_m / human.span_m
        if anchor is None:
            whole = len(human.own) == len(FINGERS)
            near = LIKE_A_PERSON[0] < scale < LIKE_A_PERSON[1]
            anchor = "wrist" if whole and near else "pads"
        check_name("anchor", anchor, ANCHORS)
        names = [FINGERS.index(name) for name in self.fingers]
        joints = np.insert(human.fingers[names], 0, human.wrist, axis=1)[:, :4]
        palm = human.palm([self.fingers[i] for i in self._across])
        pads = human.pads[names]
        bones = np.diff(joints, axis=1)
        bones *= self.lengths[..., None] / np.linalg.norm(bones, axis=-1, keepdims=True)
        points = np.empty_like(self._rest)
        if anchor == "wrist":
            points[0] = human.wrist
            points[self.rows] = human.wrist + np.cumsum(bones, axis=1)
        else:
            points[self.rows[:, 2]] = pads
            points[self.rows[:, 1]] = pads - bones[:, 2]
            points[self.rows[:, 0]] = pads - bones[:, 2] - bones[:, 1]
            rotation = palm @ self._axes.T
            back = (self._rest[0] - self._rest[self.rows[self._across, 0]]) @ rotation.T
            points[0] = (points[self.rows[self._across, 0]] + back).mean(axis=0)
        weights = np.empty(len(points))
        weights[0], *others = _WEIGHTS[anchor]
        weights[self.rows] = others
        for row, name in zip(self.rows, self.fingers, strict=True):
            # A finger that was not measured only needs to be roughly in place.
            weights[row] *= 1.0 if name in human.own else 0.1
        return Targets(points, weights, palm, _PALM_WEIGHT[anchor], scale, anchor)

    def measured(self, human: Keypoints) -> list[int]:
        """Return the indices of the robot's fingers that follow a measured human finger."""
        return [i for i, name in enumerate(self.fingers) if name in human.own]


def _check(hand: str, fingers: tuple[str, ...], fingertips: list[int], points: int) -> None:
    if len(fingers) != len(fingertips):
        raise ConfigError(
            f"hand '{hand}': hand.human_fingers names {amount(len(fingers), 'finger')}, "
            f"hand.fingertips has {len(fingertips)}; inverse kinematics needs one for each"
        )
    for name in fingers:
        check_name(f"human finger in hand.human_fingers of '{hand}'", name, FINGERS)
    if len(set(fingers)) < len(fingers) or len(set(fingers) - {"thumb"}) < 2:
        raise ConfigError(
            f"hand '{hand}': hand.human_fingers is {', '.join(fingers)}; each finger needs its own "
            "human finger, and a palm needs two or more besides the thumb"
        )
    if sorted(fingertips) != list(range(3, 3 * len(fingertips) + 1, 3)) or (
        points != 3 * len(fingertips) + 1
    ):
        raise ConfigError(
            f"hand '{hand}': inverse kinematics needs hand.points to be the wrist, then knuckle, "
            "middle and distal point of each finger, with hand.fingertips 3, 6, 9..."
        )
