"""Paths of the wrist: the carried one by hand, the feasible one by its promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from wrist import grasp_errors

from pgdm import rotations
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex
from pgdm.wrist.path import carried_path, clipped_path, feasible_path
from tiny_scene import double, reference, tiny_index


def test_wrist_follows_a_pure_shift() -> None:
    # The mount is turned by 90 degrees about z: world x is its -y, world y its x.
    ref = reference([[0.0, 0, 0], [0.1, 0.2, 0.3]])
    path = carried_path(tiny_index(), ref, torch.zeros(8).double())
    torch.testing.assert_close(path[0], torch.zeros(6).double())
    torch.testing.assert_close(path[1], double([0.2, -0.1, 0.3, 0, 0, 0]))


def test_wrist_carries_the_hand_rigidly() -> None:
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    quats = torch.nn.functional.normalize(quats[:1] + 0.3 * quats, dim=-1)
    ref = ObjectReference(torch.randn(6, 3, generator=generator, dtype=torch.float64), quats)
    index, start = tiny_index(), double([0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 0, 0])
    path = carried_path(index, ref, start)
    torch.testing.assert_close(path[0], start[:6])
    mount_quat = torch.from_numpy(index.mount_quat)
    pos = torch.from_numpy(index.mount_pos) + rotations.rotate(mount_quat, path[:, :3])
    quat = rotations.multiply(mount_quat, rotations.from_euler_xyz(path[:, 3:]))
    inverse = rotations.conjugate(ref.quat)
    seen_pos = rotations.rotate(inverse, pos - ref.pos)  # the hand, seen from the object
    seen_quat = rotations.multiply(inverse, quat)
    torch.testing.assert_close(seen_pos, seen_pos[:1].expand_as(seen_pos))
    assert (rotations.angle(seen_quat, seen_quat[:1].expand_as(seen_quat)) < 1e-7).all()


def point_errors(index: SceneIndex, ref: ObjectReference, path: torch.Tensor) -> torch.Tensor:
    """Return how far the point of the hand that held the object at the start is from it (T,) m."""
    mount_pos, mount_quat = torch.from_numpy(index.mount_pos), torch.from_numpy(index.mount_quat)
    pos = mount_pos + rotations.rotate(mount_quat, path[:, :3])
    quat = rotations.multiply(mount_quat, rotations.from_euler_xyz(path[:, 3:]))
    grasp = rotations.rotate(rotations.conjugate(quat[0]), ref.pos[0] - pos[0])
    return (pos + rotations.rotate(quat, grasp.expand_as(pos)) - ref.pos).norm(dim=1)


def smooth_motion(seed: int, reach: float) -> ObjectReference:
    """Return a motion that wanders by about ``reach`` m and turns with it."""
    generator = torch.Generator().manual_seed(seed)
    ends = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    share = torch.linspace(0, 1, 12, dtype=torch.float64)[:, None]
    pos = double([0.1, -0.2, 0.3]) + reach * (share * ends[0] + share**2 * ends[1])
    angles = share * ends[2] + share**2 * ends[3] * 0.5
    return ObjectReference(pos, rotations.from_euler_xyz(angles))


def made(seed: int, reach: float) -> tuple[SceneIndex, ObjectReference, torch.Tensor]:
    """Return an index with random control ranges, a motion, and a start that may be beyond them."""
    random, index = np.random.default_rng(seed), tiny_index()
    low, high = (end * random.uniform(0.3, 1.2, 8) for end in (index.ctrl_low, index.ctrl_high))
    start = double([*random.uniform(-1, 1, 3), *random.uniform(-1.5, 1.5, 3), 0, 0])
    return replace(index, ctrl_low=low, ctrl_high=high), smooth_motion(seed, reach), start


def costs(
    index: SceneIndex, ref: ObjectReference, start: torch.Tensor, path: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """Return what each step of a path (T, 6) costs, m^2, see `feasible_path`.

    ``last``, (T, 3) or (3,), are the hinges before. The slides are not eliminated here.
    """
    carried = rotations.from_euler_xyz(carried_path(index, ref, start)[:, 3:])
    turned = rotations.angle(rotations.from_euler_xyz(torch.from_numpy(path[:, 3:])), carried)
    change = np.linalg.norm(path[:, 3:] - last, axis=1)
    off = grasp_errors(index, ref, start.numpy(), path)
    return off**2 + (0.03 * turned.numpy()) ** 2 + (0.003 * change) ** 2


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), reach=st.floats(0.0, 1.5))
def test_a_feasible_path_keeps_the_ranges_and_costs_no_more_than_a_clipped_one(
    seed: int, reach: float
) -> None:
    index, ref, start = made(seed, reach)
    path, clipped = (f(index, ref, start).numpy() for f in (feasible_path, clipped_path))
    assert ((path >= index.ctrl_low[:6]) & (path <= index.ctrl_high[:6])).all()
    last = np.concatenate((clipped[:1], path[:-1]))[:, 3:]
    assert (
        costs(index, ref, start, path, last) <= costs(index, ref, start, clipped, last) + 1e-8
    ).all()


@pytest.mark.parametrize("seed", range(3))
def test_another_solver_finds_no_better_step_nearby(seed: int) -> None:
    # Far outside the ranges another posture may be better still; the path does not jump to it.
    index, ref, start = made(seed, 1.0)
    path, step = feasible_path(index, ref, start).numpy(), 7
    low, high = index.ctrl_low[:6], index.ctrl_high[:6]

    def cost(joints: np.ndarray) -> float:
        tried = np.repeat(joints[None], len(path), axis=0)
        return float(costs(index, ref, start, tried, path[step - 1, 3:])[step])

    random, bounds = np.random.default_rng(seed), list(zip(low, high, strict=True))
    found = min(
        (
            minimize(cost, begin.clip(low, high), method="SLSQP", bounds=bounds)
            for begin in random.normal(path[step], [[0.02], [0.1], [0.3]], (3, 6))
        ),
        key=lambda result: result.fun,
    )
    assert cost(path[step]) <= found.fun + 1e-5
    errors = (
        grasp_errors(index, ref, start.numpy(), np.repeat(joints[None], len(path), axis=0))[step]
        for joints in (path[step], found.x)
    )
    assert next(errors) <= next(errors) + 1e-3


def test_where_the_base_reaches_a_feasible_path_is_the_carried_one() -> None:
    ref = smooth_motion(0, 0.1)
    start = double([0.1, -0.2, 0.3, 0.1, -0.1, 0.2, 0, 0])
    index = tiny_index()
    carried, feasible = carried_path(index, ref, start), feasible_path(index, ref, start)
    assert torch.equal(carried, clipped_path(index, ref, start))  # within the ranges throughout
    torch.testing.assert_close(feasible, carried, atol=0.02, rtol=0)
    assert point_errors(index, ref, feasible).max() < 1e-3


def test_a_slide_at_its_end_is_made_up_for_by_turning() -> None:
    # The object turns in place by a right angle about world z, 0.5 m from the base. Carried along,
    # the base would swing around it by 0.5 m each way, but its first slide (world y) has 0.1 m.
    index = tiny_index()
    index = SceneIndex(**{**vars(index), "ctrl_low": index.ctrl_low * np.r_[0.1, np.ones(7)]})
    index = SceneIndex(**{**vars(index), "ctrl_high": index.ctrl_high * np.r_[0.1, np.ones(7)]})
    angles = torch.zeros(10, 3).double()
    angles[:, 2] = torch.linspace(0, torch.pi / 2, 10)
    ref = ObjectReference(double([[0.0, 0.0, 0.2]] * 10), rotations.from_euler_xyz(angles))
    start = torch.zeros(8).double()
    clipped, feasible = clipped_path(index, ref, start), feasible_path(index, ref, start)
    assert point_errors(index, ref, clipped)[-1] > 0.2
    assert point_errors(index, ref, feasible).max() < 0.01


def test_the_start_is_where_the_hand_is() -> None:
    index, ref = tiny_index(), smooth_motion(3, 0.2)
    start = double([0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 0, 0])
    torch.testing.assert_close(feasible_path(index, ref, start)[0], start[:6], atol=1e-6, rtol=0)


def test_the_grasp_point_is_off_by_what_a_slide_is() -> None:
    index, ref = tiny_index(), smooth_motion(0, 0.1)
    start = double([0.1, -0.2, 0.3, 0.1, -0.1, 0.2, 0, 0])
    path = carried_path(index, ref, start).numpy()
    path[1:, 0] += 0.1
    errors = grasp_errors(index, ref, start.numpy(), path)
    np.testing.assert_allclose(errors, [0.0, *[0.1] * (len(path) - 1)], atol=1e-12)
