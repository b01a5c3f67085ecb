"""A policy that Stable-Baselines3 trained: pgdm reads it, acts as it does, and evaluates it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import command
from pgdm.errors import CheckpointError
from pgdm.export import sb3

TASK = "hammer-use1"


@pytest.mark.filterwarnings("ignore")  # of Stable-Baselines3's dependencies
def test_a_policy_of_stable_baselines3(library_home: Path, tmp_path: Path) -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import VecNormalize

    import pgdm

    env = VecNormalize(pgdm.make_sb3(TASK, num_envs=2, num_threads=1, offline=True), clip_obs=5.0)
    kwargs = {
        "net_arch": {"pi": [256, 128], "vf": [256, 128]},
        "activation_fn": torch.nn.Tanh,
        "log_std_init": -1.6,
    }
    model = stable_baselines3.PPO(
        "MlpPolicy", env, n_steps=16, batch_size=16, policy_kwargs=kwargs, seed=0, device="cpu"
    )
    model.learn(32)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "vecnormalize.pkl"))

    policy = sb3.read(tmp_path / "model.zip", TASK, vecnormalize=tmp_path / "vecnormalize.pkl")
    assert (policy.frames, policy.network.cfg.obs_dim) == (32, 322)
    rng = np.random.default_rng(0)
    obs = env.obs_rms.mean + 3 * rng.standard_normal((50, 322)) * np.sqrt(env.obs_rms.var)
    theirs, _ = model.predict(env.normalize_obs(obs), deterministic=True)
    ours = policy.network.act(torch.from_numpy(obs).float(), deterministic=True)
    assert np.abs(ours.numpy().clip(-1, 1) - theirs).max() < 1e-5
    noise = policy.network.state_dict()["log_std"].exp()
    assert noise.numpy() == pytest.approx(model.policy.log_std.exp().detach().numpy())
    raw = sb3.read(tmp_path / "model.zip", TASK)
    theirs, _ = model.predict(obs.astype(np.float32), deterministic=True)
    ours = raw.network.act(torch.from_numpy(obs).float(), deterministic=True)
    assert np.abs(ours.numpy().clip(-1, 1) - theirs).max() < 1e-5

    arguments = ("eval", "model.zip", "--task", TASK, "--vecnormalize", "vecnormalize.pkl")
    outcome = command("pgdm", *arguments, "--offline", "--episodes", "2", "--video")
    assert "success, within 1 cm" in outcome.out and "model.zip (32 frames)" in outcome.out
    if "no OpenGL" not in outcome.err:
        assert outcome.code == 0, outcome.err
        assert (tmp_path / "model.mp4").stat().st_size > 0
    outcome = command("pgdm", "eval", "model.zip", "--task", "dmanus-crackerbox", "--offline")
    assert outcome.code == 1 and "it belongs to another task" in outcome.err
    swapped = VecNormalize(pgdm.make_sb3("dmanus-crackerbox", num_envs=1, offline=True))
    swapped.save(str(tmp_path / "other.pkl"))
    with pytest.raises(CheckpointError, match="it belongs to another policy"):
        sb3.read(tmp_path / "model.zip", TASK, vecnormalize=tmp_path / "other.pkl")
