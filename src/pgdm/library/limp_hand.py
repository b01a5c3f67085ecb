"""From the joints of a human hand to those of a robot hand, by pulling a limp one along.

The way the published trajectories were made: a robot hand without motors, each of its points tied
to a point of a human hand whose bones were given the robot's lengths. With the object in its place
the published fingers come out to 0.06 rad and 1.8 mm at their tips; `benchmark/retarget.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.check import compiled


@dataclass(frozen=True)
class PulledHand:
    """Which points of a robot hand are pulled, and by what."""

    points: tuple[str, ...]
    """Bodies (P,) at the hand's points, in the order of the human joints."""
    parents: tuple[int, ...]
    """Of each human joint the one before it on the way from the wrist; the wrist's is itself."""
    wrist_anchor_m: tuple[float, float, float]
    """What of the first point's body is tied to the human wrist, in the body's frame, m."""


ADROIT = PulledHand(
    points=(
        "wrist_point",
        *("ffknuckle_point", "ffmiddle_point", "ffdistal_point"),
        *("mfknuckle_point", "mfmiddle_point", "mfdistal_point"),
        *("lfknuckle_point", "lfmiddle_point", "lfdistal_point"),
        *("rfknuckle_point", "rfmiddle_point", "rfdistal_point"),
        *("thknuckle_point", "thmiddle_point", "thdistal_point"),
    ),
    parents=(0, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14),
    # Measured: the published trajectories have Adroit's first wrist joint at the human wrist, but
    # the bones' lengths count from the palm's point, 34 mm further.
    wrist_anchor_m=(0.0, 0.0, -0.034),
)
"""Adroit, as the published trajectories were made."""

TIMESTEP_S = 0.004
STEPS = 10
"""Physics steps of a frame."""
SETTLING_STEPS = 2000
"""Physics steps on the first frame before the motion begins."""

_PULL_DELAY = 1
"""Steps of a frame before the hand's points move on to its targets. The simulation that made the
published trajectories computed its forces at the end of a step: 2.6 mm apart without, 1.7 with."""

_HAND, _THING, _PULL = "hand/", "thing/", "pull"


def bone_scaled(joints: np.ndarray, lengths: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Return a hand with bones of other lengths in the same directions.

    Args:
        joints: (N, P, 3) m.
        lengths: of the bone that ends at each joint (P,) m; the wrist's does not count.
        parents: of each joint the one before it; a joint comes after its parent.

    Returns:
        Joints (N, P, 3) m; the wrist stays where it is.
    """
    result = joints.copy()
    for i, parent in enumerate(parents):
        if i != parent:
            bone = joints[:, i] - joints[:, parent]
            unit = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
            result[:, i] = result[:, parent] + lengths[i] * unit
    return result


class LimpHand:
    """A robot hand without motors above the table, beside an object that is put where it belongs.

    Args:
        table: MJCF of the scene.
        hand: MJCF of the hand.
        thing: MJCF of the object.
        pulled: the hand's points.

    Raises:
        CorruptAssetError: a model does not compile or lacks a point.
    """

    def __init__(self, table: Path, hand: Path, thing: Path, pulled: PulledHand = ADROIT) -> None:
        self._pulled = pulled
        label = f"{hand.parent.name} with {thing.parent.name}"
        self._model = compiled(table, label, lambda spec: _assemble(spec, hand, thing, pulled))
        self._points = [self._model.body(_HAND + name).id for name in pulled.points]
        for i in range(len(pulled.points)):
            # The compiler has taken the anchors from where the bodies happened to be.
            anchors = self._model.eq(f"{_PULL}{i}").data[:6]
            anchors[:] = 0.0
            if i == 0:
                anchors[:3] = pulled.wrist_anchor_m
        bodies = [self._model.body(i).name for i in self._model.jnt_bodyid]
        self._joints = sum(name.startswith(_HAND) for name in bodies)
        self.lengths = self._bone_lengths()
        """Lengths of the robot's bones, straight hand (P,) m."""

    def track(
        self, human_joints: np.ndarray, position: np.ndarray, rotation: np.ndarray
    ) -> np.ndarray:
        """Return the robot's joints (N, J), m and rad, one row a frame.

        The object starts every frame where it was in the frame before and is free until the next,
        as in the simulation that made the published trajectories. The joints may leave their
        limits: the pull is stronger.

        Args:
            human_joints: (N, P, 3) m, world frame.
            position: of the object's body (N, 3) m, world frame.
            rotation: of the object's body (N, 4), unit quaternions wxyz.
        """
        targets = bone_scaled(human_joints, self.lengths, self._pulled.parents)
        model, data = self._model, mujoco.MjData(self._model)
        poses = np.concatenate((position, rotation), axis=1)
        result = np.empty((len(targets), self._joints))
        data.mocap_pos[:] = targets[0]
        for _ in range(SETTLING_STEPS):
            self._put(data, poses[0])
            mujoco.mj_step(model, data)
        for i, target in enumerate(targets):
            self._put(data, poses[max(i - 1, 0)])
            mujoco.mj_step(model, data, _PULL_DELAY)
            data.mocap_pos[:] = target
            mujoco.mj_step(model, data, STEPS - _PULL_DELAY)
            result[i] = data.qpos[: self._joints]
        return result

    def points(self, joints: np.ndarray) -> np.ndarray:
        """Return the robot's points (N, P, 3) m, world frame, at joints (N, J)."""
        data = mujoco.MjData(self._model)
        result = np.empty((len(joints), len(self._points), 3))
        for i, row in enumerate(joints):
            data.qpos[: self._joints] = row
            mujoco.mj_kinematics(self._model, data)
            result[i] = data.xpos[self._points]
        return result

    def _put(self, data: mujoco.MjData, pose: np.ndarray) -> None:
        data.qpos[self._joints :] = pose
        data.qvel[self._joints :] = 0.0

    def _bone_lengths(self) -> np.ndarray:
        rest = self.points(np.zeros((1, self._joints)))[0]
        return np.linalg.norm(rest - rest[list(self._pulled.parents)], axis=1)


def _assemble(spec: mujoco.MjSpec, hand: Path, thing: Path, pulled: PulledHand) -> None:
    for path, prefix in ((hand, _HAND), (thing, _THING)):
        part = mujoco.MjSpec.from_file(str(path))
        if prefix == _THING:
            _free(part, path)
        spec.attach(part, prefix=prefix, frame=spec.worldbody.add_frame())
    spec.option.timestep = TIMESTEP_S
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    body = mujoco.mjtObj.mjOBJ_BODY
    for i, point in enumerate(pulled.points):
        if spec.body(_HAND + point) is None:
            raise CorruptAssetError(f"{hand}: the hand has no body '{point}'")
        name = f"{_PULL}{i}"
        spec.worldbody.add_body(name=name, mocap=True)
        spec.add_equality(
            name=name,
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=body,
            name1=_HAND + point,
            name2=name,
        )


def _free(spec: mujoco.MjSpec, path: Path) -> None:
    """Give an object a free joint in place of its six single ones: its pose is then a row."""
    body = spec.worldbody.first_body()
    if body is None:
        raise CorruptAssetError(f"{path}: the object has no body")
    for joint in list(body.joints):
        spec.delete(joint)
    body.add_freejoint()
