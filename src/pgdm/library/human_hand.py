"""From the points of one hand to the joints of another that made the same motion.

Everything here is arithmetic on arrays: N frames, metres, world frame unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgdm.library.expert_file import HUMAN_JOINTS

LAG_FRAMES = 0.5
"""By how much MyoHand's recordings lag behind the motion capture: the hand was pulled along."""

RIDGE = 0.01
"""Penalty of the regression, per sample and standardised feature."""

_STILL_M = 1e-5
"""Coordinates that vary by less do not count: the knuckles are fixed in the palm."""


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices (N, 3, 3) of unit quaternions wxyz (N, 4)."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) nearest to given matrices (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones(matrix.shape[:-1])
    signs[..., 2] = np.linalg.det(u @ vt)
    return (u * signs[..., None, :]) @ vt


def rigid(
    position: np.ndarray, rotation: np.ndarray, onto: np.ndarray, onto_rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the one rigid transform that brings the poses of a body to others.

    Args:
        position: (N, 3) m.
        rotation: (N, 3, 3).
        onto: where the positions should be (N, 3) m.
        onto_rotation: where the orientations should be (N, 3, 3).

    Returns:
        A rotation (3, 3) and a translation (3,) m, applied in this order; least squares.
    """
    turn = nearest_rotation(np.einsum("nij,nkj->ik", onto_rotation, rotation))
    return turn, (onto - position @ turn.T).mean(axis=0)


def later(values: np.ndarray, frames: float) -> np.ndarray:
    """Return values (N, ...) a part of a frame later, 0..1, by straight lines between frames.

    The last row goes on as the one before it did.
    """
    step = np.diff(values, axis=0)
    return values + frames * np.concatenate((step, step[-1:]))


@dataclass(frozen=True)
class PalmView:
    """What a hand looks like from its palm, N frames."""

    origin: np.ndarray = field(repr=False)
    """Of the palm (N, 3) m, world frame."""
    turn: np.ndarray = field(repr=False)
    """Orientation of the palm (N, 3, 3)."""
    features: np.ndarray = field(repr=False)
    """Coordinates of the other points in the palm's frame (N, 3 (P-1)), m."""

    @classmethod
    def of(cls, points: np.ndarray, palm: np.ndarray) -> PalmView:
        """Take the view of points (N, P, 3), the first of them the palm's origin."""
        origin = points[:, 0]
        local = np.einsum("nji,npj->npi", palm, points[:, 1:] - origin[:, None])
        return cls(origin, palm, local.reshape(len(points), -1))

    def seen(self, joints: np.ndarray) -> np.ndarray:
        """Return world positions (N, J, 3) in the palm's frame, (N, 3 J)."""
        local = np.einsum("nji,npj->npi", self.turn, joints - self.origin[:, None])
        return local.reshape(len(joints), -1)

    def placed(self, local: np.ndarray) -> np.ndarray:
        """Return positions in the palm's frame (N, 3 J) in the world, (N, J, 3)."""
        joints = local.reshape(len(local), -1, 3)
        return self.origin[:, None] + np.einsum("nij,npj->npi", self.turn, joints)


@dataclass(frozen=True)
class Ridge:
    """A linear map of standardised features, fitted with a penalty on its size."""

    mean: np.ndarray = field(repr=False)
    """Of the features (F,)."""
    scale: np.ndarray = field(repr=False)
    """Standard deviations (F,), infinite where a feature does not vary."""
    weights: np.ndarray = field(repr=False)
    """(F, G)."""
    offset: np.ndarray = field(repr=False)
    """Mean of the targets (G,)."""

    @classmethod
    def fit(cls, features: np.ndarray, targets: np.ndarray, penalty: float = RIDGE) -> Ridge:
        """Fit targets (N, G) to features (N, F)."""
        mean, offset = features.mean(axis=0), targets.mean(axis=0)
        spread = features.std(axis=0)
        scale = np.where(spread < _STILL_M, np.inf, spread)
        z = (features - mean) / scale
        gram = z.T @ z + penalty * len(z) * np.eye(z.shape[1])
        return cls(mean, scale, np.linalg.solve(gram, z.T @ (targets - offset)), offset)

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Return the targets (N, G) of features (N, F)."""
        return (features - self.mean) / self.scale @ self.weights + self.offset


def human_joints(view: PalmView, ridge: Ridge) -> np.ndarray:
    """Return the human hand's joints (N, 16, 3) m, MANO order, of another hand's view."""
    joints = view.placed(ridge(view.features))
    return joints.reshape(len(joints), HUMAN_JOINTS, 3)
