"""Computing a human hand's joint locations from points of another hand that made the same motion.

Arrays cover N frames; positions are in m, in the world frame unless stated otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgdm.library.files.expert import HUMAN_JOINTS

LAG_FRAMES = 0.5
"""Frames by which MyoHand, a musculoskeletal hand model, lags behind the human hand pulling it."""

RIDGE = 0.01
"""Ridge penalty per sample, for standardised features."""

_STILL_M = 1e-5
"""Coordinates with a smaller standard deviation are ignored, such as those of the knuckles, which
are fixed in the palm."""


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (N, 3, 3) of unit quaternions wxyz (N, 4)."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotations nearest to matrices (..., 3, 3) (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones(matrix.shape[:-1])
    signs[..., 2] = np.linalg.det(u @ vt)
    return (u * signs[..., None, :]) @ vt


def rigid(
    position: np.ndarray, rotation: np.ndarray, onto: np.ndarray, onto_rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rigid transform that best maps the poses of a body to target poses.

    Least squares: ``R = argmin sum |R rotation - onto_rotation|^2`` (orthogonal Procrustes), then
    ``t = mean(onto - R position)``.

    Args:
        position: (N, 3) m.
        rotation: (N, 3, 3).
        onto: target positions (N, 3) m.
        onto_rotation: target orientations (N, 3, 3).

    Returns:
        The rotation R (3, 3) and the translation t (3,) m, applied in this order.
    """
    best = nearest_rotation(np.einsum("nij,nkj->ik", onto_rotation, rotation))
    return best, (onto - position @ best.T).mean(axis=0)


def later(values: np.ndarray, frames: float) -> np.ndarray:
    """Return values (N, ...) at times that are later by ``frames`` (0 to 1), interpolated linearly.

    The last row is extrapolated from the last two.
    """
    step = np.diff(values, axis=0)
    return values + frames * np.concatenate((step, step[-1:]))


@dataclass(frozen=True)
class PalmView:
    """A hand's points in the frame of its palm, over N frames."""

    origin: np.ndarray = field(repr=False)
    """Origin of the palm (N, 3) m, world frame."""
    rotation: np.ndarray = field(repr=False)
    """Orientation of the palm (N, 3, 3)."""
    features: np.ndarray = field(repr=False)
    """Coordinates of the P-1 points other than the origin, in the palm's frame (N, 3 (P-1)), m."""

    @classmethod
    def of(cls, points: np.ndarray, palm: np.ndarray) -> PalmView:
        """Return the view of points (N, P, 3) m, the palm's origin first; ``palm`` is (N, 3, 3)."""
        origin = points[:, 0]
        local = np.einsum("nji,npj->npi", palm, points[:, 1:] - origin[:, None])
        return cls(origin, palm, local.reshape(len(points), -1))

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Transform world positions (N, J, 3) to the palm's frame, (N, 3 J)."""
        local = np.einsum("nji,npj->npi", self.rotation, points - self.origin[:, None])
        return local.reshape(len(points), -1)

    def placed(self, local: np.ndarray) -> np.ndarray:
        """Transform positions in the palm's frame (N, 3 J) to the world frame, (N, J, 3)."""
        points = local.reshape(len(local), -1, 3)
        return self.origin[:, None] + np.einsum("nij,npj->npi", self.rotation, points)


@dataclass(frozen=True)
class Ridge:
    """Ridge regression on standardised features.

    ``W = argmin |Z W - (Y - mean Y)|^2 + penalty N |W|^2`` for features Z and targets Y.
    """

    mean: np.ndarray = field(repr=False)
    """Means of the features (F,)."""
    scale: np.ndarray = field(repr=False)
    """Standard deviations (F,), infinite where a feature does not vary."""
    weights: np.ndarray = field(repr=False)
    """The map W (F, G)."""
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
    """Return the human hand's joints (N, 16, 3) m, MANO order, predicted from another hand."""
    joints = view.placed(ridge(view.features))
    return joints.reshape(len(joints), HUMAN_JOINTS, 3)
