"""Immutable references, indexed by control step: the object's motion and the expert's hand."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.library import Expert, Motion

# The targets this many control steps ahead are observed (released code).
STEPS_AHEAD = (1, 5, 10)
# Frequencies of the encoding of time (released code).
TIME_FREQUENCIES = (1, 4, 6, 8)


@dataclass(frozen=True)
class ReferenceCfg:
    """How the stored poses of a motion become targets."""

    frame: str
    """``released``: stored positions are used as targets of the centre of mass, as in the released
    code; ``com_corrected``: stored positions are those of the mesh's origin, as recorded, and each
    target is the centre of mass of the object in that pose."""


FRAMES = ("released", "com_corrected")


@dataclass(frozen=True)
class ObjectReference:
    """The exemplar motion x_0..x_{T-1} of the tracked object, world frame, float64."""

    pos: Tensor
    """(T, 3) m, targets of the object's centre of mass."""
    quat: Tensor
    """(T, 4) unit quaternions, wxyz, targets of the object body's orientation."""

    @classmethod
    def of(cls, motion: Motion) -> ObjectReference:
        """Return a stored motion as a reference, with the positions unchanged (``released``)."""
        return cls(torch.as_tensor(motion.translation), torch.as_tensor(motion.orientation))

    def com_corrected(self, com: Tensor) -> ObjectReference:
        """Return targets for the centre of mass, if stored poses are those of the body's origin.

        Positions become x_t + R(x_t) com; orientations stay.

        Args:
            com: (3,) m, the centre of mass in the body's frame.
        """
        offset = rotations.rotate(self.quat, com.expand_as(self.pos))
        return ObjectReference(self.pos + offset, self.quat)

    def __len__(self) -> int:
        """Return T, the number of poses; an episode has at most T-1 steps."""
        return self.pos.shape[0]

    def ahead(self) -> Tensor:
        """Return the future targets that are observed at each step t, (T, 21) (released code).

        For each k of ``STEPS_AHEAD``: orientation (4), then position (3) of x_{min(t+k, T-1)}.
        """
        now = torch.arange(len(self), device=self.pos.device)
        ahead = [(now + k).clamp(max=len(self) - 1) for k in STEPS_AHEAD]
        return torch.cat([torch.cat((self.quat[j], self.pos[j]), -1) for j in ahead], -1)

    def time_encoding(self) -> Tensor:
        """Return sin(c t/T) for each c of ``TIME_FREQUENCIES``, then cos(c t/T), (T, 8)."""
        now = torch.arange(len(self), dtype=torch.float64) / len(self)
        phase = now[:, None] * torch.tensor(TIME_FREQUENCIES, dtype=torch.float64)
        return torch.cat((phase.sin(), phase.cos()), -1).to(self.pos.device)


@dataclass(frozen=True)
class ExpertReference:
    """The expert's hand along the motion, float64; row t belongs to pose t of the motion."""

    joints: Tensor
    """(T, nu) joint positions of the Adroit hand, clipped to their limits, m and rad."""
    fingertips: Tensor
    """(T, F, 3) m, fingertips of the Adroit hand, world frame."""
    contacts: Tensor
    """(T, F, 3) m, the object's surface point that each human finger touches or is closest to,
    relative to the object's centre of mass, in the object body's frame."""
    in_contact: Tensor
    """(T, F) bool, whether the human finger touches the object."""

    @classmethod
    def of(
        cls, expert: Expert, joint_low: Tensor, joint_high: Tensor, com: Tensor
    ) -> ExpertReference:
        """Return a stored expert as a reference.

        Args:
            expert: expert from the library.
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
        """Return the expert's contact points at steps ``t``, with the object in given poses.

        Args:
            t: (n,) steps since reset.
            com: (n, 3) m, the object's centre of mass, world frame.
            quat: (n, 4) wxyz, orientation of the object's body.

        Returns:
            (n, F, 3) m, world frame.
        """
        return com[:, None] + rotations.rotate(quat[:, None], self.contacts[t])
