"""Terms that compare the hand with an expert's, against hand-computed numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pgdm.errors import ConfigError
from pgdm.mdp import rewards, terminations
from pgdm.mdp.context import StepContext
from pgdm.mdp.measures import contact_distance, finger_joint_error, fingertip_error
from pgdm.mdp.schedules import Ramp
from pgdm.motion.reference import ExpertReference
from pgdm.sim.batch import SimState
from tiny_scene import QUARTER_Z, double, tiny_index

# Two fingers, the last point first; one base joint, a slide, and three finger joints.
INDEX = replace(tiny_index(), fingertips=np.array([2, 1]), num_joints=4, num_base_joints=1)
EXPERT = ExpertReference(
    joints=double([[0.0, 0, 0, 0], [0.1, 0.2, 0.3, 0.4], [0.0, 0, 0, 0]]),
    fingertips=double([[[0.0, 0, 0]] * 2, [[0.1, 0, 0], [0, 0.2, 0]], [[0.0, 0, 0]] * 2]),
    # Relative to the centre of mass in the body's frame: 1 cm along x, 2 cm along y.
    contacts=double([[[9.0, 9, 9]] * 2, [[0.01, 0, 0], [0, 0.02, 0]], [[9.0, 9, 9]] * 2]),
    in_contact=torch.tensor([[False, False], [True, True], [True, False]]),
)
PREGRASP = double([[-0.3, -0.1, 0.0], [-0.1, -0.04, 0.0]])  # fingertips on the object


def context(t: int = 1, expert: ExpertReference | None = EXPERT) -> StepContext:
    """One simulation: fingertips at (0.1, 0, 0.03) and (0.04, 0.2, 0); the object at (0, 0.3, 0),
    rotated by 90 degrees about z."""
    state = SimState(
        qpos=double([[0.4, 0.2, 0.0, 0.4, 7.0]]),  # the last entry is the object's
        qvel=double([[0.0] * 5]),
        point_pos=double([[[5.0, 5, 5], [0.04, 0.2, 0.0], [0.1, 0.0, 0.03]]]),
        point_quat=double([[[1.0, 0, 0, 0]] * 3]),
        point_vel=double([[[0.0] * 6] * 3]),
        object_pos=double([[0.0, 0.3, 0.0]]),
        object_quat=double([QUARTER_Z]),
        object_vel=double([[0.0] * 6]),
    )
    steps = torch.tensor([t])
    zero = double([[0.0, 0, 0]])
    target = zero, double([[1.0, 0, 0, 0]])
    return StepContext(state, steps, 2, *target, zero[:, 0], PREGRASP, INDEX, expert)


def test_kept_grasp_by_hand() -> None:
    # On the object the fingertips are at (-0.3, -0.1, 0.03) and (-0.1, -0.04, 0) m; the first has
    # moved by 3 cm.
    expected = (math.exp(-20 * 0.03) + 1) / 2
    assert rewards.kept_grasp(context(), 20.0).tolist() == pytest.approx([expected], abs=1e-12)


@pytest.mark.parametrize(
    ("space", "form", "error"),
    [
        # Fingertips are off by (0, 0, 0.03) and (0.04, 0, 0): as one vector, by 0.05.
        ("fingertips", "norm", 0.05),
        ("fingertips", "squared", 0.0025),
        # Joints are off by 0.3 m of slide and 0.3 rad of the second hinge.
        ("joints", "squared", 0.18),
        ("joints", "norm", math.sqrt(0.18)),
    ],
)
def test_hand_error_with_its_reward_and_termination(space: str, form: str, error: float) -> None:
    c = context()
    assert c.hand_error(space, form).item() == pytest.approx(error)
    reward = rewards.hand_imitation(c, space, form, 15.0)
    assert reward.item() == pytest.approx(math.exp(-15.0 * error))
    lost = [
        terminations.hand_lost(c, space, form, limit, grace_steps=0).item()
        for limit in (0.99 * error, 1.01 * error)
    ]
    assert lost == [True, False]


@pytest.mark.parametrize(("grace", "lost"), [(0, True), (1, False), (2, False)])
def test_the_hand_is_never_lost_in_the_grace_steps(grace: int, lost: bool) -> None:
    c = context(t=1)  # the state after the first step has t = 1
    flag = terminations.hand_lost(c, "fingertips", "norm", 0.01, grace_steps=grace)
    assert flag.tolist() == [lost]


def test_contact_points_move_with_the_object() -> None:
    # A quarter turn about z takes the body's x to the world's y and its y to -x.
    points = context().contact_points
    torch.testing.assert_close(points, double([[[0.0, 0.31, 0.0], [-0.02, 0.3, 0.0]]]))


FIRST = math.sqrt(0.1**2 + 0.31**2 + 0.03**2)
SECOND = math.sqrt(0.06**2 + 0.1**2)


def test_the_contact_reward_is_the_mean_over_the_fingers() -> None:
    c = context()
    norm = 0.5 * (math.exp(-15 * FIRST) + math.exp(-15 * SECOND))
    squared = 0.5 * (math.exp(-15 * FIRST**2) + math.exp(-15 * SECOND**2))
    assert rewards.fingertip_contact(c, "norm", 15.0).item() == pytest.approx(norm)
    assert rewards.fingertip_contact(c, "squared", 15.0).item() == pytest.approx(squared)
    assert contact_distance(c).item() == pytest.approx((FIRST + SECOND) / 2)


def test_only_fingers_in_contact_count() -> None:
    # At step 2 only the first finger, at (9, 9, 9) in the body's frame: (-9, 9.3, 9) in the world.
    distance = math.sqrt(9.1**2 + 9.3**2 + 8.97**2)
    c = context(t=2)
    expected = math.exp(-0.1 * distance)
    assert rewards.fingertip_contact(c, "norm", 0.1).item() == pytest.approx(expected)
    assert contact_distance(c).item() == pytest.approx(distance)


def test_without_expert_contact_the_reward_is_zero_and_the_distance_nan() -> None:
    c = context(t=0)
    assert rewards.fingertip_contact(c, "squared", 15.0).item() == 0.0
    assert math.isnan(contact_distance(c).item())


def test_errors_in_plain_units() -> None:
    c = context()
    assert fingertip_error(c).item() == pytest.approx(0.035)  # mean of 3 and 4 cm
    assert finger_joint_error(c).item() == pytest.approx(0.1)  # 0, 0.3, 0 rad; not the slide


@pytest.mark.parametrize("term", [fingertip_error, finger_joint_error, contact_distance])
def test_a_recipe_that_does_not_declare_its_expert_is_an_error(
    term: Callable[[StepContext], Tensor],
) -> None:
    with pytest.raises(ConfigError, match="needs_expert=True"):
        term(context(expert=None))


@pytest.mark.parametrize(
    ("frames", "weight"), [(0, 0.0), (1_000_000, 2.5), (4_000_000, 10.0), (50_000_000, 10.0)]
)
def test_the_ramp_is_linear_and_then_constant(frames: int, weight: float) -> None:
    assert Ramp("tracking", 10.0, 4_000_000)(frames) == {"tracking": weight}
