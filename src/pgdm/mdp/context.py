"""Input of the MDP's terms, built once per control step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.errors import ConfigError
from pgdm.motion.reference import ExpertReference
from pgdm.sim.batch import SimState
from pgdm.sim.scene import SceneIndex

SPACES = ("fingertips", "joints")
"""Quantities in which the hand is compared with the expert's."""
FORMS = ("squared", "norm")
"""Forms of a distance: |d|^2 or |d|."""


def on_object(state: SimState, index: SceneIndex) -> Tensor:
    """Return the fingertips relative to the object's centre of mass, in its frame, (n, F, 3) m."""
    offset = state.point_pos[:, torch.from_numpy(index.fingertips)] - state.object_pos[:, None]
    return rotations.rotate(rotations.conjugate(state.object_quat)[:, None], offset)


@dataclass(frozen=True)
class StepContext:
    """State of n simulations after a step, and the targets of that step."""

    state: SimState
    t: Tensor  # (n,) int64, steps since reset
    last_t: int  # T-1, index of the last pose of the motion
    target_pos: Tensor  # (n, 3) m, where the object's centre of mass should be
    target_quat: Tensor  # (n, 4) wxyz
    start_height: Tensor  # (n,) m, height of the object's centre of mass at reset
    pregrasp_fingertips: Tensor  # (F, 3) m, fingertips at reset, in the object's frame
    index: SceneIndex
    expert: ExpertReference | None = None

    @cached_property
    def object_error(self) -> Tensor:
        """e, distance of the object's centre of mass from its target, (n,) m."""
        return torch.linalg.vector_norm(self.target_pos - self.state.object_pos, dim=-1)

    @cached_property
    def object_angle(self) -> Tensor:
        """phi, angle between the object and its target, (n,) rad in [0, pi]."""
        return rotations.angle(self.state.object_quat, self.target_quat)

    @cached_property
    def fingertips(self) -> Tensor:
        """Positions of the hand's fingertips, (n, F, 3) m."""
        return self.state.point_pos[:, torch.from_numpy(self.index.fingertips)]

    @cached_property
    def fingertips_on_object(self) -> Tensor:
        """Positions of the fingertips in the object's frame, (n, F, 3) m."""
        return on_object(self.state, self.index)

    @cached_property
    def joints(self) -> Tensor:
        """Positions of the hand's joints, coupled ones too, (n, J) m and rad."""
        return self.state.qpos[:, : self.index.num_joints]

    @cached_property
    def fingertip_offset(self) -> Tensor:
        """Fingertips minus the expert's at the same step, (n, F, 3) m."""
        return self.fingertips - self._expert.fingertips[self.t]

    @cached_property
    def joint_offset(self) -> Tensor:
        """Joints minus the expert's at the same step, (n, J) m and rad."""
        return self.joints - self._expert.joints[self.t]

    @cached_property
    def in_contact(self) -> Tensor:
        """Whether each of the expert's fingers touches the object at the same step, (n, F) bool."""
        return self._expert.in_contact[self.t]

    @cached_property
    def contact_points(self) -> Tensor:
        """The expert's contact (or closest) points on the object where it is now, (n, F, 3) m."""
        s = self.state
        return self._expert.contact_points(self.t, s.object_pos, s.object_quat)

    @cached_property
    def contact_distance(self) -> Tensor:
        """Distance of each fingertip from its point in ``contact_points``, (n, F) m."""
        return torch.linalg.vector_norm(self.contact_points - self.fingertips, dim=-1)

    def hand_error(self, space: str, form: str) -> Tensor:
        """Return |h - h_expert|^2 (``squared``) or |h - h_expert| (``norm``), (n,).

        h is one vector: the 3 F coordinates of the fingertips, m (``fingertips``), or the J joint
        positions, m for slides and rad for hinges (``joints``).
        """
        squared = self._squared_fingertips if space == "fingertips" else self._squared_joints
        return squared if form == "squared" else squared.sqrt()

    @cached_property
    def _squared_fingertips(self) -> Tensor:
        return self.fingertip_offset.square().sum((1, 2))

    @cached_property
    def _squared_joints(self) -> Tensor:
        return self.joint_offset.square().sum(1)

    @property
    def _expert(self) -> ExpertReference:
        if self.expert is None:
            raise ConfigError(
                "a term of this method compares the hand with an expert's, but its recipe does not "
                "declare it: use Recipe(..., needs_expert=True)"
            )
        return self.expert
