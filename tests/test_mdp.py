"""Terms, metrics, observations and actions against hand-computed numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgdm import rotations
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.mdp import rewards, terminations
from pgdm.mdp.actions import ActionCfg, action_map
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import Episodes, MetricsCfg, episode_metrics
from pgdm.mdp.observations import ObsCfg, layout, relative, released
from pgdm.sim.batch import SimState
from tiny_scene import IDENTITY, QUARTER_Z, double, reference, tiny_index

CFG = MetricsCfg(success_threshold_m=0.01, lift_height_m=0.02)
ABSOLUTE = ActionCfg("absolute", 3, 0.25, 1.0, "carried", 0, False)
RESIDUAL = replace(ABSOLUTE, kind="residual")
PLANNED = replace(RESIDUAL, wrist_path="planned")
ZERO = torch.zeros(8).double()


def state(pos: list, quat: list) -> SimState:
    n = len(pos)
    return SimState(
        qpos=double([[0.1, 0.2]] * n),
        qvel=double([[0.3, 0.4]] * n),
        point_pos=double([[[1.0, 2.0, 3.0]]] * n),
        point_quat=double([[IDENTITY]] * n),
        point_vel=double([[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]] * n),
        object_pos=double(pos),
        object_quat=double(quat),
        object_vel=double([[7.0, 8.0, 9.0, 10.0, 11.0, 12.0]] * n),
    )


def context(pos: list, quat: list, target: list, target_quat: list, t: int = 1) -> StepContext:
    n = len(pos)
    return StepContext(
        state(pos, quat),
        torch.full((n,), t),
        5,
        double(target),
        double(target_quat),
        double([0.1] * n),
        double([[0.0, 0.0, 0.0]]),
        tiny_index(),
    )


def test_tracking_reward_by_hand() -> None:
    # e = 0.03 m and a quarter turn: exp(-50 (0.03 + 0.1 * 0.5)) = exp(-4).
    c = context([[0.03, 0, 0.1]], [QUARTER_Z], [[0, 0, 0.1]], [IDENTITY])
    assert rewards.tracking(c, 50.0, 0.1).item() == pytest.approx(math.exp(-4.0), rel=1e-9)


def test_the_lift_bonus_needs_object_and_target_above_the_height() -> None:
    up, down = [0.0, 0.0, 0.121], [0.0, 0.0, 0.119]
    c = context([up, up, down], [IDENTITY] * 3, [up, down, up], [IDENTITY] * 3)
    assert rewards.lift(c, 0.02).tolist() == [1.0, 0.0, 0.0]


def test_the_object_is_lost_exactly_at_the_limit() -> None:
    c = context([[0.25, 0, 0], [0.2499, 0, 0]], [IDENTITY] * 2, [[0.0, 0, 0]] * 2, [IDENTITY] * 2)
    assert terminations.object_lost(c, 0.25).tolist() == [True, False]


@pytest.mark.parametrize(("t", "ended"), [(4, False), (5, True)])
def test_the_motion_ends_at_its_last_pose(t: int, ended: bool) -> None:
    c = context([[0.0, 0, 0]], [IDENTITY], [[0.0, 0, 0]], [IDENTITY], t)
    assert terminations.motion_ended(c).item() is ended


def test_corrected_targets_are_positions_of_the_centre_of_mass() -> None:
    # The centre of mass lies 1 cm along the body's x; a quarter turn about z makes that world y.
    ref = reference([[1.0, 2.0, 3.0]] * 2, [IDENTITY, QUARTER_Z])
    corrected = ref.com_corrected(double([0.01, 0.0, 0.0]))
    torch.testing.assert_close(corrected.pos, double([[1.01, 2.0, 3.0], [1.0, 2.01, 3.0]]))


def test_metrics_of_a_constant_error_of_two_millimetres() -> None:
    # Over 85 steps the released error is 2e-3 sqrt(85) / 85 = 2.169e-4.
    ref = reference([[0.0, 0.0, 0.0]] * 86)
    pos = torch.zeros(1, 86, 3, dtype=torch.float64)
    pos[..., 0] = 0.002
    quat = double([[QUARTER_Z] * 86])
    m = episode_metrics(Episodes(pos, quat, torch.tensor([85])), ref, CFG)
    assert m["com_error"].item() == pytest.approx(0.002)
    assert m["com_error_released"].item() == pytest.approx(2.169e-4, rel=1e-3)
    assert m["ori_error"].item() == pytest.approx(math.pi / 2)
    assert m["success"].item() == 1.0
    assert math.isnan(m["lifted"].item())  # nothing to lift


def test_after_an_early_termination_the_last_pose_counts_but_not_as_lifted() -> None:
    # Targets at 0, 3, 3, 3 cm; the object is lifted at step 1, and the episode stops at step 2.
    ref = reference([[0.0, 0, 0], [0.0, 0, 0.03], [0.0, 0, 0.03], [0.0, 0, 0.03]])
    pos = double([[[0.0, 0, 0], [0.0, 0, 0.025], [0.0, 0, 0.01], [9.0, 9, 9]]])
    quat = double([[IDENTITY] * 4])
    m = episode_metrics(Episodes(pos, quat, torch.tensor([2])), ref, CFG)
    assert m["com_error"].item() == pytest.approx((0.005 + 0.02 + 0.02) / 3)
    assert m["success"].item() == pytest.approx(1 / 3)
    assert m["lifted"].item() == pytest.approx(1 / 3)
    assert m["dropped"].item() == 1.0
    assert m["length"].item() == 2.0


def test_released_observation_entry_by_entry() -> None:
    ref = reference([[float(k), 0.0, 0.0] for k in range(4)])
    index = tiny_index()
    observe = released(index, ref)
    obs = observe(state([[5.0, 6.0, 7.0]], [QUARTER_Z]), torch.tensor([2]))[0]
    expected = [0.1, 0.2, 1, 2, 3, 5, 6, 7, *IDENTITY, *QUARTER_Z, 0.3, 0.4]
    expected += [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    expected += [*IDENTITY, 3.0, 0, 0] * 3  # 1, 5 and 10 steps ahead: all at the last pose
    phase = [c * 2 / 4 for c in (1, 4, 6, 8)]
    expected += [math.sin(p) for p in phase] + [math.cos(p) for p in phase]
    np.testing.assert_allclose(obs.numpy(), expected, rtol=1e-6)


def test_relative_observation_entry_by_entry() -> None:
    # Targets at x = 0, 1, 2, 3 m, turned by a quarter about z at the step observed, t = 2.
    ref = reference([[float(k), 0.0, 0.0] for k in range(4)], [IDENTITY] * 2 + [QUARTER_Z] * 2)
    index, now = tiny_index(), torch.tensor([2])
    s = state([[2.03, 0.5, 0.0]], [IDENTITY])
    observe = relative(index, ref)
    obs = observe(s, now)[0].double()
    near, later = [-0.03, -0.5, 0.0], [0.97, -0.5, 0.0]  # t+5 is after the last pose
    expected = [*near, *later, *later, *(math.tanh(x / 0.03) for x in near)]
    expected += [0.0, 0.0, math.sqrt(2)]  # twice the vector part of a quarter turn
    point = s.point_pos[0, 0]
    expected += [
        *(s.object_pos[0] - point),
        *s.object_quat[0],
        *(s.object_vel - s.point_vel[:, 0])[0, :3],
    ]
    expected += [*(s.point_pos[0, torch.from_numpy(index.fingertips)] - s.object_pos[0]).flatten()]
    extra = len(expected)
    np.testing.assert_allclose(obs[:extra], np.array(expected, float), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(obs[extra:], released(index, ref)(s, now)[0].double())


def test_relative_entries_of_hand_and_object_turn_with_them() -> None:
    """Moving and turning hand and object together changes none of the entries of the grasp."""
    ref, index = reference([[0.0, 0, 0]] * 2), tiny_index()
    s = state([[2.0, 0.5, 0.1]], [QUARTER_Z])
    quarter, shift = double([QUARTER_Z]), double([[0.3, -0.2, 1.0]])
    turned = replace(
        s,
        object_pos=rotations.rotate(quarter, s.object_pos) + shift,
        object_quat=-rotations.multiply(quarter, s.object_quat),  # the same rotation
        point_pos=rotations.rotate(quarter[:, None], s.point_pos) + shift[:, None],
        point_quat=rotations.multiply(quarter[:, None], s.point_quat),
        object_vel=rotations.rotate(quarter[:, None], s.object_vel.view(1, 2, 3)).flatten(1),
        point_vel=rotations.rotate(
            quarter[:, None, None], s.point_vel.unflatten(-1, (2, 3))
        ).flatten(2),
    )
    observe, now = relative(index, ref), torch.tensor([0])
    grasp = slice(15, 25 + 3 * len(index.fingertips))
    torch.testing.assert_close(observe(s, now)[0, grasp], observe(turned, now)[0, grasp])
    assert not torch.allclose(observe(s, now)[0, :15], observe(turned, now)[0, :15])


def test_unknown_layouts_and_kinds_are_errors_that_list_the_valid_ones() -> None:
    ref = reference([[0.0, 0, 0]] * 2)
    with pytest.raises(UnknownNameError, match="released"):
        layout(ObsCfg("relesed"), tiny_index(), ref)
    with pytest.raises(UnknownNameError, match="residual"):
        action_map(replace(ABSOLUTE, kind="residul"), tiny_index(), ref, ZERO)


def test_absolute_actions_are_affine_and_clipped() -> None:
    ref = reference([[0.0, 0, 0]] * 3)
    amap = action_map(ABSOLUTE, tiny_index(), ref, ZERO)
    ctrl = amap.act(torch.tensor([[0.5, 0, 0, 0, 0, 0, 0.5, 9.0]]), torch.tensor([0]))[0]
    torch.testing.assert_close(ctrl, double([0.5, 0, 0, 0, 0, 0, 0.75, 2.0]))


def test_warm_start_adds_0_2_to_the_second_joint_and_the_fingers() -> None:
    ref = reference([[0.0, 0, 0]] * 3)
    start = double([0.5, 0, 0, 1.0, 0, 0, 0.5, 1.9])
    amap = action_map(ABSOLUTE, tiny_index(), ref, start)
    torch.testing.assert_close(amap.warm_start, double([0.5, 0.2, 0, 0.5, 0, 0, 0.2, 1.0]))


def test_only_a_clipped_path_leaves_room_for_corrections_at_the_limit() -> None:
    # The path goes to 1.5 where the control range ends at 1: a correction of -0.25 starts at 1.5,
    # or at 1 if clipped.
    ref = reference([[0.0, 0, 0], [0.0, 1.5, 0.0]])
    action, t = torch.tensor([[-1.0, 0, 0, 0, 0, 0, 0, 0]]), torch.tensor([1])
    for path, expected in (("carried", 1.0), ("clipped", 0.75)):
        amap = action_map(replace(RESIDUAL, wrist_path=path), tiny_index(), ref, ZERO)
        assert amap.act(action, t)[0, 0].item() == pytest.approx(expected)


def test_residual_leads_by_three_steps_and_corrects_by_a_quarter() -> None:
    ref = reference([[0.0, 0.01 * k, 0.0] for k in range(10)])
    amap = action_map(RESIDUAL, tiny_index(), ref, ZERO)
    action = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0, 0], [0.0] * 8])
    ctrl = amap.act(action, torch.tensor([2, 8]))
    # Step 2: target of step 5 (world y 0.05 = mount x), plus 0.25 * 1 * half-range 1.
    assert ctrl[0, 0].item() == pytest.approx(0.05 + 0.25)
    assert ctrl[1, 0].item() == pytest.approx(0.09)  # beyond the motion: its last pose
    assert amap.warm_start[:6].abs().max() == 0.0


def test_a_power_makes_small_corrections_smaller() -> None:
    cfg = replace(RESIDUAL, residual_power=2.0)
    amap = action_map(cfg, tiny_index(), reference([[0.0, 0, 0]] * 4), ZERO)
    ctrl = amap.act(torch.tensor([[-0.5] + [0.0] * 7, [1.0] + [0.0] * 7]), torch.tensor([0, 0]))
    # A quarter of the half-range 1, times -0.5^2 and 1^2.
    assert ctrl[:, 0].tolist() == pytest.approx([-0.25 * 0.25, 0.25])


def test_planned_commands_are_sent_unchanged_and_corrected() -> None:
    ref = reference([[0.0, 0.01 * k, 0.0] for k in range(4)])
    commands = double([[0.1 * k, 0, 0, 0, 0, 0] for k in range(1, 4)])
    amap = action_map(PLANNED, tiny_index(), ref, ZERO, commands)
    action = torch.tensor([[0.0] * 8, [0.0] * 8, [1.0, 0, 0, 0, 0, 0, 0, 0]])
    ctrl = amap.act(action, torch.tensor([0, 2, 3]))
    # No lead; the last command is repeated; corrected by a quarter of the half-range.
    assert ctrl[:, 0].tolist() == pytest.approx([0.1, 0.3, 0.3 + 0.25])


def test_a_planned_wrist_without_commands_is_an_error() -> None:
    ref = reference([[0.0, 0, 0], [0.1, 0, 0]])
    with pytest.raises(ConfigError, match="base commands of a wrist plan"):
        action_map(PLANNED, tiny_index(), ref, ZERO)
