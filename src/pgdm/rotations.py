"""Batched rotations in torch. Quaternions are unit quaternions, wxyz; all functions broadcast."""

from __future__ import annotations

import torch
from torch import Tensor


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Return the Hamilton product p q, (..., 4): the rotation by q, then by p."""
    pw, px, py, pz = p.unbind(-1)
    qw, qx, qy, qz = q.unbind(-1)
    return torch.stack(
        (
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ),
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse of a unit quaternion, (..., 4)."""
    return q * q.new_tensor([1.0, -1.0, -1.0, -1.0])


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) by unit quaternions q (..., 4)."""
    w, u = q[..., :1], q[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    t = 2.0 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def angle(p: Tensor, q: Tensor) -> Tensor:
    """Return the angle of the rotation between p and q, (...), rad in [0, pi].

    4 atan2(min(|p - q|, |p + q|), max(|p - q|, |p + q|)): unlike 2 arccos |p . q|, it is accurate
    near 0. The sign of a quaternion does not matter.
    """
    apart, together = torch.linalg.vector_norm(torch.stack((p - q, p + q)), dim=-1)
    return 4.0 * torch.atan2(torch.minimum(apart, together), torch.maximum(apart, together))


def to_matrix(q: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    basis = torch.eye(3, dtype=q.dtype, device=q.device)
    columns = [rotate(q, basis[i].expand(*q.shape[:-1], 3)) for i in range(3)]
    return torch.stack(columns, dim=-1)


def from_euler_xyz(angles: Tensor) -> Tensor:
    """Return quaternions (..., 4) of intrinsic X-Y-Z Euler angles (..., 3), rad."""
    half = 0.5 * angles
    c, s = half.cos(), half.sin()
    zero = torch.zeros_like(c[..., 0])
    qx = torch.stack((c[..., 0], s[..., 0], zero, zero), -1)
    qy = torch.stack((c[..., 1], zero, s[..., 1], zero), -1)
    qz = torch.stack((c[..., 2], zero, zero, s[..., 2]), -1)
    return multiply(multiply(qx, qy), qz)


def to_euler_xyz(q: Tensor) -> Tensor:
    """Return intrinsic X-Y-Z Euler angles (..., 3), rad, of unit quaternions (..., 4).

    The middle angle lies in [-pi/2, pi/2]. At +-pi/2 (gimbal lock) only the sum or difference of
    the other two is determined; how it is split between them is arbitrary.
    """
    m = to_matrix(q)
    return torch.stack(
        (
            torch.atan2(-m[..., 1, 2], m[..., 2, 2]),
            torch.asin(m[..., 0, 2].clamp(-1.0, 1.0)),
            torch.atan2(-m[..., 0, 1], m[..., 0, 0]),
        ),
        dim=-1,
    )


def unwrap(angles: Tensor) -> Tensor:
    """Remove jumps of 2*pi along the first dimension of angles (T, ...), rad."""
    step = angles.diff(dim=0)
    turns = torch.round(step / (2.0 * torch.pi)).cumsum(0)
    return torch.cat((angles[:1], angles[1:] - 2.0 * torch.pi * turns))
