"""Where the points of a robot hand should be so that it does what a human hand does."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.pregrasp.keypoints import FINGERS, Keypoints, filled, palm_axes
from pgdm.sim.scene import Scene

ANCHORS = ("wrist", "pads")
"""What of the human hand stays where it is when its bones get the robot's lengths: the wrist, as
the published trajectories were made, or the pads of the fingers, for hands of another size."""

LIKE_A_PERSON = 0.8, 1.35
"""Hands of so many times the human hand's length count as of its size."""

_PAD_WEIGHT = 1.0
_WEIGHTS = {"wrist": (0.6, 0.6, 0.6, 1.0), "pads": (0.05, 0.05, 0.1, 1.0)}
"""Weights of wrist, knuckles, middle joints and tips, per m of error."""
_PALM_WEIGHT = {"wrist": 0.0, "pads": 0.02}
"""Weight of the palm's orientation, per rad of error."""
_LAST_M = 0.01
"""From a finger's distal joint to the middle of its last bone."""


@dataclass(frozen=True)
class Targets:
    """What inverse kinematics should reach, world frame."""

    points: np.ndarray = field(repr=False)
    """Of the hand's points (P, 3) m."""
    weights: np.ndarray = field(repr=False)
    """Of the points (P,), per m; 0 leaves a point free."""
    palm: np.ndarray = field(repr=False)
    """Orientation of the palm (3, 3), axes as in :func:`pgdm.pregrasp.keypoints.palm_axes`."""
    palm_weight: float
    """Per rad."""
    scale: float
    """Length of the robot's hand divided by the human's."""
    anchor: str
    """One of :data:`ANCHORS`."""


class HandShape:
    """The points of a scene's hand and how they belong together.

    Args:
        scene: with its hand.

    Raises:
        ConfigError: the hand's points are not its wrist, then knuckle, middle and distal point of
            each finger, or its ``human_fingers`` do not fit its fingertips.
    """

    def __init__(self, scene: Scene) -> None:
        hand, model = scene.hand, scene.model
        self.fingers = tuple(hand.human_fingers)
        """Human finger of each robot finger, in the order of the hand's fingertips."""
        _check(hand.name, self.fingers, hand.fingertips, len(hand.points))
        self.rows = np.array([[tip - 2, tip - 1, tip] for tip in hand.fingertips])
        """Rows (F, 3) of the points: knuckle, middle, distal."""
        self.first_finger_joint = hand.num_base_joints + hand.num_wrist_joints
        self.palm_body = int(model.jnt_bodyid[self.first_finger_joint - 1])
        """Body that the last wrist joint moves."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        rest = data.geom_xpos[scene.index.point_geoms]
        turn = data.xmat[self.palm_body].reshape(3, 3)
        self._across = [i for i, name in enumerate(self.fingers) if name != "thumb"]
        self._across.sort(key=lambda i: _ACROSS.index(self.fingers[i]))
        self.lengths = np.linalg.norm(
            np.diff(np.insert(rest[self.rows], 0, rest[0], axis=1), axis=1), axis=-1
        )
        """Of the bones wrist to knuckle to middle to distal point, hand at rest (F, 3) m."""
        axes = palm_axes(rest[0], rest[self.rows[self._across, 0]])
        self.palm_in_body = turn.T @ axes
        """Palm's axes in the frame of the palm's body (3, 3)."""
        self._rest, self._axes = rest, axes

    @property
    def span_m(self) -> float:
        """Length of the longest finger from the wrist on."""
        return float(self.lengths.sum(axis=1).max())

    def keypoints(self, points: np.ndarray) -> Keypoints:
        """Return the human hand that has its joints at the robot's points (P, 3) m."""
        known = {}
        for name, (knuckle, middle, distal) in zip(self.fingers, points[self.rows], strict=True):
            last = distal - middle
            last = _LAST_M * last / max(float(np.linalg.norm(last)), 1e-9)
            known[name] = np.stack((knuckle, middle, distal - last, distal + last))
        return filled(points[0], known)

    def targets(self, human: Keypoints, anchor: str | None = None) -> Targets:
        """Return where the points should be.

        Args:
            human: the hand to follow.
            anchor: one of :data:`ANCHORS`; by default the wrist, if all five fingers were
                measured and the robot's hand has the human's size.
        """
        scale = self.span_m / human.span_m
        if anchor is None:
            whole = len(human.own) == len(FINGERS)
            near = LIKE_A_PERSON[0] < scale < LIKE_A_PERSON[1]
            anchor = "wrist" if whole and near else "pads"
        if anchor not in ANCHORS:
            raise UnknownNameError("anchor", anchor, ANCHORS)
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
            turn = palm @ self._axes.T
            back = (self._rest[0] - self._rest[self.rows[self._across, 0]]) @ turn.T
            points[0] = (points[self.rows[self._across, 0]] + back).mean(axis=0)
        weights = np.empty(len(points))
        weights[0], *others = _WEIGHTS[anchor]
        weights[self.rows] = others
        for row, name in zip(self.rows, self.fingers, strict=True):
            # A finger that was not measured should only not be in the way.
            weights[row] *= 1.0 if name in human.own else 0.1
        return Targets(points, weights, palm, _PALM_WEIGHT[anchor], scale, anchor)

    def measured(self, human: Keypoints) -> list[int]:
        """Return which of the robot's fingers follow a finger that was measured."""
        return [i for i, name in enumerate(self.fingers) if name in human.own]


_ACROSS = ("index", "middle", "ring", "little")


def _check(hand: str, fingers: tuple[str, ...], fingertips: list[int], points: int) -> None:
    if len(fingers) != len(fingertips):
        raise ConfigError(
            f"hand '{hand}': hand.human_fingers names {len(fingers)} fingers, hand.fingertips has "
            f"{len(fingertips)}; inverse kinematics needs one for each"
        )
    for name in fingers:
        if name not in FINGERS:
            raise UnknownNameError(f"human finger in hand.human_fingers of '{hand}'", name, FINGERS)
    if len(set(fingers)) < len(fingers) or len(set(fingers) - {"thumb"}) < 2:
        raise ConfigError(
            f"hand '{hand}': hand.human_fingers is {', '.join(fingers)}; each finger needs a human "
            "finger of its own, and two or more besides the thumb make a palm"
        )
    if sorted(fingertips) != list(range(3, 3 * len(fingertips) + 1, 3)) or (
        points != 3 * len(fingertips) + 1
    ):
        raise ConfigError(
            f"hand '{hand}': inverse kinematics needs hand.points to be the wrist, then knuckle, "
            "middle and distal point of each finger, with hand.fingertips 3, 6, 9..."
        )
