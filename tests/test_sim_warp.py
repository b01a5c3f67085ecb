"""MuJoCo Warp as the engine of training, on its CPU device."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pgdm.cli.run import main as run
from pgdm.config.compose import compose
from pgdm.config.identity import difference
from pgdm.envs.batch_env import BatchEnv
from pgdm.errors import ConfigError, SceneError
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.rl.replay import Column, Replay
from pgdm.runs.files import RESULT, read_json
from pgdm.seeding import torch_stream

try:
    import pgdm.sim.warp as warp
except ConfigError:
    warp = None

pytestmark = pytest.mark.usefixtures("library_home")
needs_warp = pytest.mark.skipif(warp is None, reason="the extra gpu is not installed")
# Among them one scene of each hand, a door without a free object, a randomised box and the task
# with another timestep.
ROOT = os.environ.get("PGDM_TCDM_ROOT")
GOLDEN, PLANNED = Path(ROOT or "").parent / "golden", "motion_planned.npz"
SCENES = ("hammer-use1", "dhand-cup", "dmanus-sim2real", "door-open", "hammer-strike")


def make(*overrides: str, num_envs: int = 4, stream: str = "train") -> BatchEnv:
    builder = env_builder(compose(overrides), open_library())
    return builder.make(num_envs, 1, stream=stream)


def test_without_the_extra_the_message_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['mujoco_warp'] = None\n"
        "from pgdm.errors import ConfigError\n"
        "try:\n    import pgdm.sim.warp\nexcept ConfigError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install -c constraints.txt -e '.[gpu]'; or choose sim=default" in done.stdout


def test_the_engine_is_part_of_what_a_run_is() -> None:
    plain, other = compose(["task=hammer-use1"]), compose(["task=hammer-use1", "sim=warp"])
    assert difference(plain, other) == ["sim.engine: mujoco -> warp"]
    with pytest.raises(ConfigError, match=r"unknown sim.engine value 'wrap'; did you mean warp\?"):
        compose(["task=hammer-use1", "sim.engine=wrap"])


@pytest.mark.parametrize("mirror", [None, torch.device("cpu")])
def test_a_replay_mirrored_on_a_device_is_the_same(
    tmp_path: Path, mirror: torch.device | None
) -> None:
    columns = {"x": Column(torch.float16, (3,)), "t": Column(torch.float32)}
    frames = {"x": torch.arange(18.0).reshape(6, 3), "t": torch.arange(6.0)}
    replay = Replay(columns, 12, 4, torch_stream(0, "replay"), tmp_path, mirror)
    replay.append(frames)
    written = bool(np.fromfile(tmp_path / "t.bin", np.float32).any())
    assert written == (mirror is None)  # a mirrored one waits for its state to be saved
    state, drawn = replay.state_dict(), replay.sample()
    torch.testing.assert_close(drawn["x"][:, 0], 3 * drawn["t"])
    replay.append(frames)  # as after a checkpoint, before a kill
    again = Replay(columns, 12, 4, torch_stream(0, "replay"), tmp_path, mirror)
    again.load_state_dict(state)
    torch.testing.assert_close(again.sample().to_dict(), drawn.to_dict())
    plain = Replay(columns, 12, 4, torch_stream(0, "replay"))
    plain.append(frames)
    assert state == plain.state_dict()


@needs_warp
def test_evaluations_run_in_c_mujoco() -> None:
    env = make("task=hammer-use1", "sim=warp", num_envs=2, stream="eval")
    assert type(env.sim).__name__ == "SimBatch"


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("task", SCENES)
def test_one_control_step_agrees_with_c_mujoco(task: str) -> None:
    """From shared states, as float32 errors grow in contact."""
    exact, rounded = make(f"task={task}"), make(f"task={task}", "sim=warp")
    noise, worst = torch.Generator().manual_seed(0), []
    for _ in range(12):
        for row in range(4):
            data = exact.sim.data(row)
            rounded.sim.reset(np.array([row]), data.qpos, data.qvel)
        if exact.sim.scene.task.randomize:
            rounded.sim.set_variation(np.arange(4), *exact.sim.variation())
        seen = exact.sim.read().point_vel, rounded.sim.read().point_vel
        torch.testing.assert_close(*seen, rtol=1e-3, atol=1e-3)
        action = exact.warm_start() + 0.1 * torch.randn(4, exact.action_dim, generator=noise)
        one, two = exact.step(action)[4]["qpos"], rounded.step(action)[4]["qpos"]
        worst.append((one - two).abs().amax(1))
    change = torch.cat(worst)
    assert float(change.median()) < 1e-4
    assert float(change.quantile(0.9)) < 5e-3


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("task", [t for t in SCENES if (GOLDEN / f"{t}.{PLANNED}").is_file()])
def test_first_steps_of_the_recorded_rollouts(task: str) -> None:
    """As in `test_golden`, at the engine's tolerance."""
    env = make(f"task={task}", "sim=warp", num_envs=1)
    env.reset()
    with np.load(GOLDEN / f"{task}.{PLANNED}") as record:
        for k in range(3):
            tolerance = 3e-2 if env.sim.data(0).ncon else 1e-4
            _, reward, terminated, _, info = env.step(torch.from_numpy(record["actions"][k])[None])
            np.testing.assert_allclose(info["qpos"][0], record["qpos"][k + 1], atol=tolerance)
            assert abs(float(reward[0]) - record["reward"][k]) < 100 * tolerance
            assert bool(terminated[0]) == bool(record["last"][k])


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("task", ["hammer-use1", "dhand-cup"])
def test_rollouts_have_the_same_statistics(task: str) -> None:
    """Long trajectories differ; their means over noisy rollouts do not."""
    found = []
    for engine in ("default", "warp"):
        env = make(f"task={task}", f"sim={engine}", num_envs=32)
        env.reset()
        noise, rewards, errors, ended = torch.Generator().manual_seed(0), [], [], []
        for _ in range(40):
            action = env.warm_start() + 0.1 * torch.randn(32, env.action_dim, generator=noise)
            _, reward, terminated, _, info = env.step(action)
            rewards.append(reward)
            errors.append(info["object_error_m"])
            ended.append(terminated)
        found.append([torch.stack(values).float() for values in (rewards, errors, ended)])
    for exact, rounded in zip(*found, strict=True):
        means = exact.mean(0), rounded.mean(0)  # of each simulation
        spread = torch.cat(means).std() / 32**0.5
        assert abs(means[0].mean() - means[1].mean()) < 3 * spread + 1e-6, (means, task)


@needs_warp
@pytest.mark.slow
def test_a_simulation_that_fails_ends_its_own_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    calm, env = make("task=hammer-use1", "sim=warp"), make("task=hammer-use1", "sim=warp")
    action = env.warm_start()[None].expand(4, -1)
    start = env.reset().clone()
    rows = torch.as_tensor(env.sim.rows)
    rows[1, 3] = torch.nan
    env.sim.restore(rows)
    obs, reward, _, truncated, info = env.step(action)
    assert truncated.tolist() == [False, True, False, False]
    assert info["episodes"].metrics()["diverged"].tolist() == [1.0]
    assert reward[1] == 0 and torch.isfinite(reward).all() and torch.isfinite(obs).all()
    torch.testing.assert_close(obs[1], start[1], rtol=0, atol=0)  # started again
    expected = calm.step(action)[0]
    for row in (0, 2, 3):
        torch.testing.assert_close(obs[row], expected[row], rtol=0, atol=0)
    # Rows of others do not change when one is reset.
    before = torch.as_tensor(env.sim.rows)[2]
    env.reset(np.array([0, 1]))
    torch.testing.assert_close(torch.as_tensor(env.sim.rows)[2], before, rtol=0, atol=0)
    with pytest.raises(SceneError, match="stored simulation rows have shape"):
        env.sim.restore(make("task=hammer-use1").sim.rows)
    # With too little room for contacts an episode is cut instead of simulated wrongly.
    monkeypatch.setattr(warp, "_CONSTRAINT_ROWS", 90)
    small = make("task=hammer-use1", "sim=warp")
    assert small.step(action)[3].any()


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo_fast", "sac"])
def test_a_run_trains_is_resumed_to_the_bit_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algo: str
) -> None:
    monkeypatch.chdir(tmp_path)
    common = ["task=hammer-use1", "sim=warp", f"algo={algo}", "num_envs=8", "eval.episodes=2"]
    common += [
        "algo.steps_per_env=8",
        "tracking=none",
        "eval.video=false",
        "eval.interval_frames=0",
    ]
    if algo == "ppo_fast":
        common += ["algo.minibatch_size=32"]
    else:
        common += ["keep_replay=true"]
    assert run([*common, "total_frames=128", "run_dir=whole"]) == 0
    assert run([*common, "total_frames=64", "run_dir=halves"]) == 0
    assert run([*common, "total_frames=128", "run_dir=halves"]) == 0
    whole, halves = (read_json(Path(name) / RESULT) for name in ("whole", "halves"))
    assert whole["metrics"] == halves["metrics"]
    assert whole["engine"].startswith("MuJoCo Warp 4.")


@needs_warp
@pytest.mark.slow
def test_the_benchmark_runs_small_on_the_cpu(tmp_path: Path) -> None:
    script = Path(__file__).resolve().parents[1] / "benchmark" / "gpu.py"
    options = ["--device", "cpu", "--scenes", "hammer-use1", "--limit", "1", "--out", "a.json"]
    subprocess.run([sys.executable, str(script), *options], cwd=tmp_path, check=True)
    assert read_json(tmp_path / "a.json")["rows"][0]["per_s"] > 0
