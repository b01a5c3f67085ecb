"""Comparison with rollouts of the released environment on MuJoCo 3.17 (motion_planned start).

The physics is compared over the first steps, before contacts amplify rounding; every formula
(observation, reward, termination, metrics so far) at every step, in the recorded states.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from pgdm.envs.batch_env import BatchEnv
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import Episodes, episode_metrics

ROOT = os.environ.get("PGDM_TCDM_ROOT")
GOLDEN = Path(ROOT).parent / "golden" if ROOT else Path("golden")
TASKS = [
    "hammer-use1",
    "spheremedium-lift",
    "cup-pour1",
    "dhand-cup",
    "dmanus-crackerbox",
    "door-open",
    "hammer-strike",
]

pytestmark = pytest.mark.skipif(
    not GOLDEN.is_dir(),
    reason="needs the recorded rollouts, next to the folder that PGDM_TCDM_ROOT names",
)


@pytest.fixture(scope="module", params=TASKS)
def golden(request: pytest.FixtureRequest, library_home: Path) -> tuple[BatchEnv, dict]:
    import pgdm

    env = pgdm.make_batch(request.param, num_envs=1, num_threads=1, auto_reset=False)
    with np.load(GOLDEN / f"{request.param}.motion_planned.npz") as file:
        return env, dict(file)


def test_reset_observation(golden: tuple[BatchEnv, dict]) -> None:
    env, record = golden
    np.testing.assert_allclose(env.reset()[0].numpy(), record["obs"][0], atol=1e-6)


def test_warm_start_is_the_zero_action_of_the_released_code(golden: tuple[BatchEnv, dict]) -> None:
    env, record = golden
    expected = record["zero_ac"].copy()
    expected[1] += 0.2
    expected[6:] += 0.2
    np.testing.assert_allclose(env.warm_start().numpy(), np.clip(expected, -1, 1), atol=1e-6)


def test_first_steps_of_the_physics(golden: tuple[BatchEnv, dict]) -> None:
    env, record = golden
    env.reset()
    for k in range(3):
        touching = env.sim.data(0).ncon > 0
        _, reward, terminated, _, info = env.step(torch.from_numpy(record["actions"][k])[None])
        tight = 1e-2 if touching else 1e-6
        np.testing.assert_allclose(info["qpos"][0], record["qpos"][k + 1], atol=tight)
        np.testing.assert_allclose(
            info["final_obs"][0, : len(record["qpos"][0])],
            record["obs"][k + 1][: len(record["qpos"][0])],
            atol=tight,
        )
        if not touching:
            assert abs(float(reward[0]) - record["reward"][k]) < 1e-4
        assert bool(terminated[0]) == bool(record["last"][k])


def test_formulas_at_every_recorded_state(golden: tuple[BatchEnv, dict]) -> None:
    env, record = golden
    mdp, sim = env.mdp, env.sim
    nq, nv = sim.scene.model.nq, sim.scene.model.nv
    num_bodies = len(sim.scene.index.point_bodies) + 1
    velocity_at = nq + 7 * num_bodies
    reference = mdp.reference
    horizon = len(reference)
    env.reset()
    state = sim.read()
    z0 = state.object_pos[:, 2].clone()
    pos = torch.zeros(1, horizon, 3, dtype=torch.float64)
    quat = torch.zeros(1, horizon, 4, dtype=torch.float64)
    pos[:, 0], quat[:, 0] = state.object_pos, state.object_quat
    for k in range(len(record["reward"])):
        qvel = record["obs"][k + 1][velocity_at : velocity_at + nv]
        sim.reset(np.array([0]), record["qpos"][k + 1], qvel)
        state = sim.read()
        t = torch.tensor([k + 1])
        target = reference.pos[t], reference.quat[t]
        context = StepContext(
            state, t, horizon - 1, *target, z0, torch.zeros(5, 3), sim.scene.index
        )
        reward = sum(float(r.weight * r.value(context)[0]) for r in mdp.recipe.rewards)
        # Velocities of the points derive from a qvel recorded in float32: lower precision.
        np.testing.assert_allclose(
            mdp.observe(state, t)[0].numpy(), record["obs"][k + 1], atol=1e-5, rtol=1e-5
        )
        assert abs(reward - record["reward"][k]) < 1e-5
        ended = any(bool(end.reached(context)[0]) for end in mdp.recipe.ends)
        assert ended == bool(record["last"][k])
        pos[:, k + 1], quat[:, k + 1] = state.object_pos, state.object_quat
        metrics = episode_metrics(Episodes(pos, quat, t), reference, mdp.recipe.metrics)
        assert abs(float(metrics["success"][0]) - record["obj_success"][k]) < 1e-9
        assert abs(float(metrics["com_error_released"][0]) - record["obj_err"][k]) < 1e-5
