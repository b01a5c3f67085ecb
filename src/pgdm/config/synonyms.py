"""Names that other libraries use for pgdm's settings."""

from __future__ import annotations

from collections.abc import Iterable

# Names in Stable-Baselines3, rsl_rl, CleanRL and TorchRL -> keys and groups of pgdm.
_MEANT = {
    ("lr", "alpha_lr", "step_size"): ("learning_rate",),
    ("bs", "batch", "minibatch", "mini_batch_size"): ("minibatch_size", "batch_size"),
    ("n_steps", "num_steps", "horizon", "rollout_length"): ("steps_per_env",),
    ("n_epochs", "num_epochs", "update_epochs", "num_learning_epochs"): ("epochs",),
    ("clip_range", "clip_coef", "clip_param", "clip_epsilon", "eps_clip"): ("clip",),
    ("ent_coef", "entropy", "entropy_coeff"): ("entropy_coef",),
    ("vf_coef", "value_loss_coef", "critic_coeff"): ("value_coef",),
    ("gae", "lam", "lambda", "lmbda"): ("gae_lambda",),
    ("discount", "discount_factor"): ("gamma",),
    ("tau", "polyak"): ("target_rate",),
    ("alpha", "temperature"): ("temperature_init",),
    ("utd", "utd_ratio", "gradient_steps"): ("updates_per_step",),
    ("learning_starts", "init_random_frames", "warmup"): ("warmup_steps",),
    ("grad_clip", "clip_grad", "max_norm", "grad_norm"): ("max_grad_norm",),
    ("net_arch", "layers", "hidden_sizes", "hidden_dims", "num_cells"): ("hidden",),
    ("log_std", "std", "init_noise_std"): ("log_std_init",),
    ("steps", "frames", "timesteps", "total_timesteps", "total_steps", "max_steps"): (
        "total_frames",
    ),
    ("n_envs", "envs", "num_workers", "nenvs"): ("num_envs",),
    ("threads", "n_threads", "workers", "cpus", "n_jobs"): ("num_threads",),
    ("gpu", "cuda"): ("device",),
    ("out", "output", "output_dir", "logdir", "log_dir", "save_dir", "dir"): ("run_dir",),
    ("time_limit", "max_time", "timeout"): ("time_limit_min",),
    ("env", "env_id", "env_name", "motion"): ("task",),
    ("robot",): ("hand",),
    ("algorithm", "agent", "learner"): ("algo",),
    ("reward", "rewards"): ("method",),
    ("logger", "wandb", "mlflow", "track"): ("tracking",),
    ("seeds", "random_seed"): ("seed",),
    ("dt", "timestep"): ("timestep_s",),
    ("n_eval_episodes", "eval_episodes", "num_eval_episodes"): ("episodes",),
    ("eval_freq", "eval_interval", "eval_every"): ("interval_frames",),
}
_KEYS = {other: ours for others, ours in _MEANT.items() for other in others}


def meant(key: str, names: Iterable[str]) -> list[str]:
    """Return the names that an unknown key probably means.

    It may be what another library calls them, or have the same last part as they do.

    Args:
        key: an unknown key, dotted or not.
        names: the keys that exist, dotted or not.
    """
    section, _, last = key.rpartition(".")
    wanted = (last, *_KEYS.get(last.lower().replace("-", "_"), ()))
    found = [name for name in names if name.rpartition(".")[2] in wanted]
    inside = [name for name in found if section and name.startswith(f"{section}.")]
    return inside or found
