"""Adroit's kinematics, for measuring hand trajectories without a task's scene."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.checks.compiled import compiled
from pgdm.library.files.expert import FINGERTIPS, JOINTS


class ExpertHand:
    """Adroit without table and object, mounted in the world frame as in the tasks.

    Args:
        xml: MJCF of Adroit in the library.

    Raises:
        CorruptAssetError: the model does not compile, or is not Adroit.
    """

    def __init__(self, xml: Path) -> None:
        model = compiled(xml, xml.parent.name)
        names = {model.geom(i).name: i for i in range(model.ngeom)}
        if model.nq != JOINTS or not names.keys() >= set(FINGERTIPS):
            raise CorruptAssetError(
                f"{xml}: not Adroit with {JOINTS} joints and {', '.join(FINGERTIPS)}"
            )
        self._model, self._data = model, mujoco.MjData(model)
        self._tips = [names[tip] for tip in FINGERTIPS]
        self._slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
        mujoco.mj_kinematics(model, self._data)
        self._axes = self._data.xaxis[self._slides].copy()  # (3, 3), an axis per row, world frame

    def clipped(self, qpos: np.ndarray) -> np.ndarray:
        """Return joint positions (..., 30) clipped to their limits."""
        return qpos.clip(*self._model.jnt_range.T)

    def beyond_limits(self, qpos: np.ndarray) -> tuple[float, float]:
        """Return the largest excess of qpos (T, 30) over its limits: slides [m], hinges [rad]."""
        excess = np.abs(qpos - self.clipped(qpos)).max(axis=0)
        return float(excess[self._slides].max()), float(excess[~self._slides].max())

    def shifted(self, qpos: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return joint positions (T, 30) of the hand moved by ``shift`` (3,) m, world frame."""
        moved = qpos.copy()
        moved[:, self._slides] += self._axes @ shift
        return moved

    def fingertips(self, qpos: np.ndarray) -> np.ndarray:
        """Return the fingertips (T, 5, 3) m, world frame, at joint positions (T, 30)."""
        result = np.empty((len(qpos), len(FINGERTIPS), 3))
        for row, joints in zip(result, qpos, strict=True):
            self._data.qpos[:] = joints
            mujoco.mj_kinematics(self._model, self._data)
            row[:] = self._data.geom_xpos[self._tips]
        return result
