"""A minimal hand, whose actions and paths can be computed by hand."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import torch

from pgdm.library.couplings import Couplings
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex

QUARTER_Z = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
IDENTITY = [1.0, 0.0, 0.0, 0.0]


def double(values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def reference(points: list, quats: list | None = None) -> ObjectReference:
    return ObjectReference(double(points), double(quats or [IDENTITY] * len(points)))


def tiny_index() -> SceneIndex:
    """Six base joints and two fingers; the mount is rotated by 90 degrees about z."""
    return SceneIndex(
        point_geoms=np.array([0]),
        point_bodies=np.array([0]),
        object_body=1,
        fingertips=np.array([0]),
        num_joints=8,
        num_actuators=8,
        driven=np.arange(8),
        actuators=np.arange(8),
        couplings=Couplings(mujoco.MjModel.from_xml_string("<mujoco/>"), 0),
        reset=np.zeros(8),
        num_compensated=8,
        num_base_joints=6,
        ctrl_low=np.array([-1.0, -1, -1, -2, -2, -2, 0, 0]),
        ctrl_high=np.array([1.0, 1, 1, 2, 2, 2, 1, 2]),
        joint_low=np.array([-1.0, -1, -1, -2, -2, -2, 0, 0]),
        joint_high=np.array([1.0, 1, 1, 2, 2, 2, 1, 2]),
        mount_pos=np.array([0.0, -0.5, 0.2]),
        mount_quat=np.array(QUARTER_Z),
        randomized_geom=None,
    )
