"""Laws of rotations, and hand-computed numbers."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pgdm import rotations as rot

finite = st.floats(-3.0, 3.0)
quaternions = st.tuples(finite, finite, finite, finite).filter(
    lambda v: math.sqrt(sum(x * x for x in v)) > 0.1
)


def unit(values: tuple[float, ...]) -> torch.Tensor:
    q = torch.tensor(values, dtype=torch.float64)
    return q / q.norm()


@settings(deadline=None)
@given(quaternions, quaternions, st.tuples(finite, finite, finite))
def test_product_composes_rotations(a: tuple, b: tuple, v: tuple) -> None:
    p, q, x = unit(a), unit(b), torch.tensor(v, dtype=torch.float64)
    torch.testing.assert_close(
        rot.rotate(rot.multiply(p, q), x), rot.rotate(p, rot.rotate(q, x)), atol=1e-12, rtol=0
    )


@settings(deadline=None)
@given(quaternions, st.tuples(finite, finite, finite))
def test_conjugate_undoes_and_matrix_agrees(a: tuple, v: tuple) -> None:
    q, x = unit(a), torch.tensor(v, dtype=torch.float64)
    torch.testing.assert_close(rot.rotate(rot.conjugate(q), rot.rotate(q, x)), x)
    torch.testing.assert_close(rot.to_matrix(q) @ x, rot.rotate(q, x))


@settings(deadline=None)
@given(quaternions, quaternions)
def test_angle_is_symmetric_and_ignores_the_sign_of_quaternions(a: tuple, b: tuple) -> None:
    p, q = unit(a), unit(b)
    assert abs(rot.angle(p, q) - rot.angle(q, p)) < 1e-9
    assert abs(rot.angle(p, q) - rot.angle(-p, q)) < 1e-9
    assert 0.0 <= rot.angle(p, q) <= math.pi
    assert rot.angle(p, p) < 1e-7


def test_a_quarter_turn_about_z() -> None:
    q = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])  # 90 degrees about z
    torch.testing.assert_close(rot.rotate(q, torch.tensor([1.0, 0, 0])), torch.tensor([0, 1.0, 0]))
    assert abs(rot.angle(q, torch.tensor([1.0, 0, 0, 0])) - math.pi / 2) < 1e-6


@settings(deadline=None)
@given(st.tuples(finite, st.floats(-1.5, 1.5), finite))
def test_euler_round_trip(values: tuple) -> None:
    angles = torch.tensor(values, dtype=torch.float64)
    torch.testing.assert_close(rot.to_euler_xyz(rot.from_euler_xyz(angles)), angles)


def test_unwrap_removes_jumps() -> None:
    wrapped = torch.tensor([3.0, -3.0, -2.0, 3.1])[:, None]
    tau = 2 * math.pi
    expected = torch.tensor([3.0, tau - 3.0, tau - 2.0, 3.1])[:, None]
    torch.testing.assert_close(rot.unwrap(wrapped), expected)
