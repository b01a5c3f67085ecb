"""The exemplar object trajectory and the expert's: immutable; index in, target out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.library import Expert, Motion

# Steps ahead whose targets the agent sees (R, reference motion goals).
GOAL_STEPS = (1, 5, 10)
# Frequencies of the positional encoding of time (R).
TIME_FREQUENCIES = (1, 4, 6, 8)


@dataclass(frozen=True)
class ReferenceCfg:
    """How the stored poses become targets."""

    frame: str
    """``released``: the stored position is the centre of mass's target, as published;
    ``com_corrected``: it is that of the mesh's origin, as recorded, and the target is where the
    centre of mass then lies."""


FRAMES = ("released", "com_corrected")


@dataclass(frozen=True)
class ObjectReference:
    """Trajectory X = [x_0..x_{T-1}] of the followed object, world frame, float64 (SPEC 1)."""

    pos: Tensor
    """(T, 3) m, compared with the object body's centre of mass."""
    quat: Tensor
    """(T, 4) unit, wxyz, compared with the object body's orientation."""

    @classmethod
    def of(cls, motion: Motion) -> ObjectReference:
        """Take the trajectory of a stored motion."""
        return cls(torch.as_tensor(motion.translation), torch.as_tensor(motion.orientation))

    def com_corrected(self, com: Tensor) -> ObjectReference:
        """Return targets of the centre of mass for poses that are those of the body's origin.

        Args:
            com: (3,) m, the centre of mass in the body's frame.
        """
        offset = rotations.rotate(self.quat, com.expand_as(self.pos))
        return ObjectReference(self.pos + offset, self.quat)

    def __len__(self) -> int:
        """Return T, the number of poses; an episode has at most T-1 steps."""
        return self.pos.shape[0]

    def goals(self) -> Tensor:
        """Return what the agent sees of the targets ahead at every step, (T, 21).

        For each of ``GOAL_STEPS``: orientation (4), then translation (3), at the end of the
        motion those of its last pose (R).
        """
        now = torch.arange(len(self))
        ahead = [(now + k).clamp(max=len(self) - 1) for k in GOAL_STEPS]
        return torch.cat([torch.cat((self.quat[j], self.pos[j]), -1) for j in ahead], -1)

    def time_encoding(self) -> Tensor:
        """Return sin(c t/T) for c in ``TIME_FREQUENCIES``, then the cosines, (T, 8) (R)."""
        now = torch.arange(len(self), dtype=torch.float64) / len(self)
        phase = now[:, None] * torch.tensor(TIME_FREQUENCIES, dtype=torch.float64)
        return torch.cat((phase.sin(), phase.cos()), -1)


@dataclass(frozen=True)
class ExpertReference:
    """What a person's hand did along the exemplar motion, float64; row t as in the motion."""

    joints: Tensor
    """(T, nu) Adroit's joints, clipped to their limits, m and rad."""
    fingertips: Tensor
    """(T, F, 3) m, its fingertips at these joints, world frame."""
    contacts: Tensor
    """(T, F, 3) m, the object points that the human fingers touch or are closest to: from the
    object's centre of mass, along the axes of its body."""
    in_contact: Tensor
    """(T, F) bool, whether the finger touches the object."""

    @classmethod
    def of(
        cls, expert: Expert, joint_low: Tensor, joint_high: Tensor, com: Tensor
    ) -> ExpertReference:
        """Take a stored expert trajectory.

        Args:
            expert: from the library.
            joint_low: lower limits of the hand's joints, (nu,) m and rad.
            joint_high: upper limits, (nu,).
            com: (3,) m, the object's centre of mass in its body's frame.
        """
        joints = torch.as_tensor(expert.qpos)
        return cls(
            joints=joints.clamp(torch.as_tensor(joint_low), torch.as_tensor(joint_high)),
            fingertips=torch.as_tensor(expert.fingertips),
            contacts=torch.as_tensor(expert.contacts) - torch.as_tensor(com),
            in_contact=torch.as_tensor(expert.in_contact),
        )

    def __len__(self) -> int:
        """Return T, the number of poses."""
        return self.joints.shape[0]

    def contact_points(self, t: Tensor, com: Tensor, quat: Tensor) -> Tensor:
        """Return where the contact points of steps ``t`` are on the object as it lies now.

        Args:
            t: (n,) steps since reset.
            com: (n, 3) m, the object's centre of mass, world frame.
            quat: (n, 4) wxyz, its body's orientation.

        Returns:
            (n, F, 3) m, world frame.
        """
        return com[:, None] + rotations.rotate(quat[:, None], self.contacts[t])
