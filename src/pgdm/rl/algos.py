"""All learners, by their name in ``algo.learner``."""

from __future__ import annotations

from pathlib import Path

import torch

from pgdm.errors import check_name
from pgdm.rl.learner import AlgoCfg, Learner
from pgdm.rl.ppo import PPOCfg, PPOLearner, build_model
from pgdm.rl.sac import SACCfg, SACLearner
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream

ALGOS: dict[str, type[AlgoCfg]] = {"ppo": PPOCfg, "sac": SACCfg}


def algo_class(name: str) -> type[AlgoCfg]:
    """Return the settings class of a learner.

    Raises:
        UnknownNameError: if no learner has this name.
    """
    check_name("algo.learner", name, ALGOS)
    return ALGOS[name]


def build_learner(
    env: VecEnv,
    cfg: AlgoCfg,
    seed: int,
    total_frames: int,
    device: str,
    num_threads: int,
    replay_folder: Path | None,
) -> Learner:
    """Return a new learner for an environment.

    Args:
        env: environment that its policy acts in.
        cfg: settings of the learner.
        seed: the run's seed.
        total_frames: length of the training, environment steps.
        device: device of the networks.
        num_threads: threads of torch; 0: torch's default.
        replay_folder: where an off-policy learner stores its replay, or None to keep it in memory.

    Raises:
        ConfigError: if the settings are invalid or do not fit the number of simulations.
        RunError: if the files of the replay cannot be created, for example on a full disk.
    """
    cfg.check(env.num_envs)
    threads = num_threads or torch.get_num_threads()
    if isinstance(cfg, SACCfg):
        return SACLearner(env, cfg, seed, total_frames, replay_folder, device, threads)
    assert isinstance(cfg, PPOCfg)
    model = build_model(env, cfg, seed, device)
    return PPOLearner(model, cfg, torch_stream(seed, "minibatches"), threads)
