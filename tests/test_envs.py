"""Every task resets, steps and renders; the three faces agree; diverging rows end alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import pgdm
from pgdm.config.groups import available
from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.divergence import replay
from pgdm.errors import ConfigError, PgdmError, RenderError, RunError, UnknownNameError
from pgdm.sim.batch import SimBatch
from pgdm.sim.render import Renderer

pytestmark = pytest.mark.usefixtures("library_home")


def noise(env: BatchEnv, steps: int, scale: float = 0.2) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    shape = (env.num_envs, env.action_dim)
    return [
        env.warm_start() + scale * torch.randn(shape, generator=generator) for _ in range(steps)
    ]


@pytest.mark.parametrize("task", available("task"))
def test_every_task_resets_steps_and_renders(task: str) -> None:
    env = pgdm.make_batch(task, num_envs=2, num_threads=1)
    first = env.reset().clone()
    for action in noise(env, 3):
        obs, reward, _, truncated, info = env.step(action)
    assert obs.shape == (2, env.obs_dim) and obs.dtype == torch.float32
    assert torch.isfinite(obs).all() and torch.isfinite(reward).all()
    assert (reward >= 0).all() and (reward <= 12.5).all()
    assert not truncated.any()
    assert info["object_error_m"].max() < 0.5
    torch.testing.assert_close(env.reset(), first, rtol=0, atol=0)
    with Renderer(env.sim.scene.model, env.sim.scene.index.object_body, 64, 48) as renderer:
        picture = renderer.render(env.sim.data(0))
    assert picture.shape == (48, 64, 3) and picture.std() > 5


@pytest.mark.parametrize("pregrasp", ["planned", "mined", "none"])
@pytest.mark.parametrize("obs", ["released", "paper"])
@pytest.mark.parametrize("action", ["absolute", "residual"])
def test_choices_of_start_observation_and_action(pregrasp: str, obs: str, action: str) -> None:
    env = pgdm.make_batch(
        "hammer-use1", num_envs=1, num_threads=1, pregrasp=pregrasp, obs=obs, action=action
    )
    assert env.obs_dim == {"released": 322, "paper": 30 + 15 + 7 + 8}[obs]
    robot = env.sim.read().qpos[0, :30]
    assert bool((robot == 0).all()) is (pregrasp == "none")
    env.step(env.warm_start()[None])


def test_another_hand_starts_from_its_reset_pose() -> None:
    env = pgdm.make_batch("hammer-use1", num_envs=1, num_threads=1, hand="dhand", pregrasp="none")
    adroit = pgdm.make_batch("hammer-use1", num_envs=1, num_threads=1, pregrasp="mined")
    assert env.action_dim == 24
    torch.testing.assert_close(env.sim.read().qpos[0, 24:], adroit.sim.read().qpos[0, 30:])
    with pytest.raises(ConfigError, match="pregrasp=none"):
        pgdm.make_batch("hammer-use1", num_envs=1, hand="dhand", pregrasp="mined")


def test_learned_starts_exist_in_three_tasks() -> None:
    found = []
    for task in ("alarmclock-see1", "duck-inspect1", "stanfordbunny-inspect1"):
        env = pgdm.make_batch(task, num_envs=1, num_threads=1, pregrasp="learned")
        found.append(env.mdp.start.source)
    assert found == ["learned"] * 3
    with pytest.raises(ConfigError, match="no stored start 'learned'"):
        pgdm.make_batch("hammer-use1", num_envs=1, pregrasp="learned")


def test_rows_do_not_depend_on_each_other_or_on_threads() -> None:
    one = pgdm.make_batch("cup-pour1", num_envs=1, num_threads=1)
    many = pgdm.make_batch("cup-pour1", num_envs=5, num_threads=2)
    for action in noise(many, 90):
        a = one.step(action[3:4])
        b = many.step(action)
        assert torch.equal(a[0][0], b[0][3]) and a[1][0] == b[1][3] and a[2][0] == b[2][3]


def test_finished_rows_restart_and_keep_their_last_observation() -> None:
    env = pgdm.make_batch("spheremedium-lift", num_envs=3, num_threads=1)
    start = env.reset().clone()
    for _ in range(len(env.mdp.reference) - 1):
        obs, _, terminated, truncated, info = env.step(torch.zeros(3, env.action_dim))
        if terminated.any():
            break
    assert terminated.all() and not truncated.any()
    torch.testing.assert_close(obs, start, rtol=0, atol=0)
    assert not torch.equal(info["final_obs"], obs)
    metrics = info["episodes"].metrics()
    assert {"success", "com_error", "com_error_released", "ori_error", "lifted", "dropped"} <= set(
        metrics
    )
    terms = metrics["term/tracking"] + metrics["term/lift"]
    torch.testing.assert_close(terms, metrics["return"])


def test_state_goes_on_to_the_bit() -> None:
    a = pgdm.make_batch("dmanus-sim2real", num_envs=4, num_threads=2, seed=5)
    actions = noise(a, 60)
    for action in actions[:25]:
        a.step(action)
    state = a.state_dict()
    expected = [a.step(action) for action in actions[25:]]
    b = pgdm.make_batch("dmanus-sim2real", num_envs=4, num_threads=1, seed=99)
    b.load_state_dict(state)
    for action, (obs, reward, *_) in zip(actions[25:], expected, strict=True):
        got = b.step(action)
        assert torch.equal(got[0], obs) and torch.equal(got[1], reward)


def test_sim2real_varies_friction_width_and_mass_within_their_ranges() -> None:
    env = pgdm.make_batch("dmanus-sim2real", num_envs=50, num_threads=2)
    geom = env.sim.scene.index.randomized_geom
    friction, size, mass = env.sim.variation()
    assert size.min() >= 0.015 and size.max() <= 0.033 and size.std() > 0.003
    assert friction[:, 0].min() >= 0.3 and friction[:, 0].max() <= 0.7
    assert env.sim.scene.model.geom_priority[geom] == 10
    assert mass.min() >= 0.1 and mass.max() <= 0.45 and mass.std() > 0.05
    rise = env.sim.scene.model.joint("crackerbox/OBJTz").id
    weights = [env.sim.data(row).qfrc_bias[rise] for row in range(50)]
    assert weights == pytest.approx((9.81 * mass).tolist(), rel=1e-6)


def test_a_diverging_simulation_ends_alone_and_is_dumped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pgdm.config.compose import compose
    from pgdm.experiment import env_builder
    from pgdm.library import open_library

    builder = env_builder(compose(["task=hammer-use1"]), open_library())
    env = builder.make(3, 1, dump_dir=tmp_path / "diverged")
    calm = builder.make(3, 1)
    actions = noise(env, 12)
    for action in actions[:6]:
        env.step(action)
        calm.step(action)
    env.sim.rows[1, 1:20] = 1e12  # positions of one simulation, absurd but finite
    for k, action in enumerate(actions[6:]):
        obs, reward, terminated, truncated, info = env.step(action)
        expected = calm.step(action)
        assert torch.isfinite(obs).all() and torch.isfinite(reward).all()
        assert truncated.tolist() == [False, k == 0, False]
        assert torch.equal(obs[[0, 2]], expected[0][[0, 2]])
        if k == 0:
            assert info["episodes"].metrics()["diverged"].tolist() == [1.0]
            assert not terminated.any()
            torch.testing.assert_close(obs[1], calm.reset(np.array([1]))[1], rtol=0, atol=0)
    dumps = list((tmp_path / "diverged").glob("*.npz"))
    assert len(dumps) == 1
    states = replay(dumps[0], SimBatch(builder.scene, 1, 1, builder.motion.substeps))
    assert len(states) == 7


def test_a_dump_keeps_nothing_of_the_episode_before(tmp_path: Path) -> None:
    from pgdm.config.compose import compose
    from pgdm.experiment import env_builder
    from pgdm.library import open_library

    builder = env_builder(compose(["task=dmanus-sim2real"]), open_library())
    env = builder.make(2, 1, dump_dir=tmp_path)
    for action in noise(env, 5):
        env.step(action)
    env.reset(np.array([1]))
    env.step(noise(env, 1)[0])
    before = env.sim.rows[1].copy()
    env.sim.rows[1, 1:10] = 1e12
    env.step(noise(env, 1)[0])
    sim = SimBatch(builder.scene, 1, 1, builder.motion.substeps)
    states = replay(next(tmp_path.glob("*-sim1.npz")), sim)
    assert len(states) == 2
    np.testing.assert_array_equal(states[0], before)


def test_stepping_on_after_the_end_is_refused() -> None:
    env = pgdm.make_batch("duck-lift", num_envs=1, num_threads=1, auto_reset=False)
    done = False
    while not done:
        _, _, terminated, _, _ = env.step(env.warm_start()[None])
        done = bool(terminated[0])
    if int(env.t[0]) == len(env.mdp.reference) - 1:
        with pytest.raises(RunError, match="reset it"):
            env.step(env.warm_start()[None])


def test_evaluation_draws_other_boxes_than_training() -> None:
    from pgdm.config.compose import compose
    from pgdm.experiment import env_builder
    from pgdm.library import open_library

    builder = env_builder(compose(["task=dmanus-sim2real"]), open_library())
    widths = [builder.make(3, 1, 0, stream).sim.variation()[1] for stream in ("train", "eval")]
    assert not np.array_equal(*widths)


def test_restarted_rows_show_what_the_simulations_hold() -> None:
    env = pgdm.make_batch("dmanus-sim2real", num_envs=3, num_threads=1)
    for _ in range(3):
        env.step(env.warm_start().repeat(3, 1))
    rows = np.array([0, 2])
    obs = env.reset(rows)
    expected = env.mdp.observe(env.sim.read(rows), torch.zeros(2, dtype=torch.int64))
    assert torch.equal(obs[torch.from_numpy(rows)], expected)


def test_weights_change_by_name_only() -> None:
    env = pgdm.make_batch("hammer-use1", num_envs=1, num_threads=1)
    env.set_weights({"tracking": 0.0})
    _, reward, _, _, info = env.step(env.warm_start()[None])
    assert reward.item() == info["terms"]["lift"].item()
    assert info["raw_terms"]["tracking"].item() > 0
    with pytest.raises(UnknownNameError, match="tracking"):
        env.set_weights({"traking": 1.0})


# Joint velocities have no bounds, so the space has none: the checker only advises them.
@pytest.mark.filterwarnings("ignore:.*A Box observation space:UserWarning")
def test_gymnasium_env_passes_its_checker() -> None:
    env = gymnasium.make("pgdm/hammer-use1-v0", render_mode="rgb_array", pregrasp="planned")
    check_env(env.unwrapped, skip_render_check=True)  # it would open a window
    assert env.unwrapped.model.nu == 30
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (480, 640, 3)
    _, _, _, _, info = env.step(env.action_space.sample())
    assert set(info) >= {"object_error_m", "success"}
    assert env.unwrapped.data.qpos.shape == (36,)
    env.close()


def test_a_window_needs_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RenderError, match="no screen to open a window on; use render_mode='rgb_"):
        gymnasium.make("pgdm/hammer-use1-v0", render_mode="human")


_PLAYED = """
import time, gymnasium, pgdm
env = gymnasium.make("pgdm/hammer-use1-v0", render_mode="human", offline=True)
env.reset()
begin = time.monotonic()
for _ in range(10):
    env.step(env.action_space.sample())
assert time.monotonic() - begin > 9 / env.unwrapped.metadata["render_fps"]
window = env.unwrapped._window
assert window.is_open and env.render() is None
"""


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb")
@pytest.mark.parametrize("end", ["env.close(); assert not window.is_open", "pass"])
def test_a_window_shows_each_step_in_real_time_and_closes_cleanly(end: str) -> None:
    read, write = os.pipe()
    screen = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24"]
    with subprocess.Popen(screen, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        os.close(write)
        display = os.read(read, 16).decode().strip()
        env = {**os.environ, "DISPLAY": f":{display}"}
        line = [sys.executable, "-c", _PLAYED + end]
        done = subprocess.run(line, env=env, capture_output=True, text=True, check=False)
        server.terminate()
    os.close(read)
    assert done.returncode == 0, done.stderr


def test_gymnasium_names_the_valid_task() -> None:
    with pytest.raises((PgdmError, gymnasium.error.Error), match="hammer-use1"):
        gymnasium.make("pgdm/hamer-use1-v0")


def test_torchrl_env_keeps_its_specs_and_resets_rows() -> None:
    from torchrl.envs.utils import check_env_specs

    env = pgdm.make_torchrl("dmanus-crackerbox", num_envs=4, num_threads=1)
    check_env_specs(env)
    rollout = env.rollout(60, break_when_any_done=False)
    assert rollout.batch_size == torch.Size([4, 60])
    assert rollout["next", "done"].any() and not rollout["next", "truncated"].any()
    batch = pgdm.make_batch("dmanus-crackerbox", num_envs=4, num_threads=1, auto_reset=False)
    batch.reset()
    obs, reward, *_ = batch.step(rollout["action"][:, 0])
    torch.testing.assert_close(rollout["next", "observation"][:, 0], obs, rtol=0, atol=0)
    torch.testing.assert_close(rollout["next", "reward"][:, 0, 0], reward, rtol=0, atol=0)


def test_stable_baselines3_gets_the_same_steps() -> None:
    pytest.importorskip("stable_baselines3")
    env = pgdm.make_sb3("dmanus-crackerbox", num_envs=2, num_threads=1)
    batch = pgdm.make_batch("dmanus-crackerbox", num_envs=2, num_threads=1)
    obs = env.reset()
    assert obs.dtype == np.float32 and np.array_equal(obs, batch.reset().numpy())
    ended = 0
    for action in noise(batch, 60):
        obs, reward, done, infos = env.step(action.numpy())
        theirs, rewards, terminated, truncated, info = batch.step(action)
        assert np.array_equal(obs, theirs.numpy()) and np.array_equal(reward, rewards.numpy())
        assert done.dtype == bool and np.array_equal(done, (terminated | truncated).numpy())
        for row in np.flatnonzero(done):
            own = infos[row]
            assert np.array_equal(own["terminal_observation"], info["final_obs"][row].numpy())
            assert own["episode"]["r"] == own["episode_metrics"]["return"] > 0
            assert own["episode"]["l"] > 1 and own["TimeLimit.truncated"] is False
            ended += 1
    assert ended >= 2
    assert "terminal_observation" not in env.step(action.numpy())[3][0]
    assert env.env_is_wrapped(object) == [False, False] and env.get_attr("render_mode", 0) == [None]


def test_stable_baselines3_trains_on_all_simulations_at_once() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = pgdm.make_sb3("spheremedium-lift", num_envs=4, num_threads=1)
    model = sb3.PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=0, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(256)
    assert any(
        not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True)
    )
    assert len(model.ep_info_buffer) > 0  # its own record of returns and lengths


def test_each_interface_fixes_who_resets_and_says_so() -> None:
    for auto_reset in (False, True):
        with pytest.raises(ConfigError, match="make_torchrl has no argument 'auto_reset'; leave"):
            pgdm.make_torchrl("dmanus-crackerbox", auto_reset=auto_reset)
    with pytest.raises(ConfigError, match="make_sb3: auto_reset is False; it must be True"):
        pgdm.make_sb3("dmanus-crackerbox", auto_reset=False)
    with pytest.raises(ConfigError, match="make_gym has no argument 'num_envs'; leave it out: a G"):
        gymnasium.make("pgdm/dmanus-crackerbox-v0", num_envs=2)


def test_make_sb3_without_stable_baselines3_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("pgdm.make.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install -c constraints.txt -e '.\[sb3\]'"):
        pgdm.make_sb3("hammer-use1")


@pytest.mark.slow
def test_stable_baselines3_trains_on_the_gymnasium_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make("pgdm/spheremedium-lift-v0")
    model = sb3.PPO("MlpPolicy", env, n_steps=256, batch_size=64, seed=0, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(1024)
    assert any(
        not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True)
    )
