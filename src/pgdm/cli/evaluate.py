"""``pgdm eval``: a policy of a run, measured again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from pgdm.cli.summary import metrics_table
from pgdm.cli.train import notify
from pgdm.config.saved import FILE, load_config
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.build import EnvBuilder
from pgdm.envs.film import film_policy
from pgdm.errors import CheckpointError, RunError
from pgdm.experiment import assets, check_assets, env_builder, threads
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint
from pgdm.rl.evaluate import Evaluator, load_policy
from pgdm.rl.networks import ActorCritic, SquashedPolicy
from pgdm.stop import StopRequest


@dataclass(frozen=True)
class EvalRequest:
    """What to measure, and how."""

    path: Path
    """A run's folder, or a checkpoint file inside one."""
    episodes: int | None
    """Episodes of the sampled policy; None: as many as in the run."""
    video: bool
    """Whether to film it."""
    deterministic: bool
    """Whether to leave the sampled policy out."""
    best: bool
    """Of a run folder: the best checkpoint instead of the last."""
    seed: int | None
    """Of the action noise and the task's own randomness; None: the run's."""
    offline: bool
    """Whether missing assets are an error instead of being fetched."""


def evaluate_policy(request: EvalRequest) -> int:
    """Print a policy's metrics and return the exit code.

    Raises:
        PgdmError: if the run or checkpoint is missing, damaged or of another environment.
    """
    run_dir, checkpoint = find_checkpoint(request.path, request.best)
    cfg = load_config(run_dir)
    if request.seed is not None:
        cfg = replace(cfg, seed=request.seed)
    policy, state = load_policy(checkpoint), read_checkpoint(checkpoint)
    frames = int(state["frames"])
    cfg = replace(cfg, offline=request.offline or cfg.offline)
    builder = env_builder(cfg, assets(cfg, notify))
    check_assets(state.get("metadata", {}), builder, checkpoint, notify)
    for note in builder.notes:
        notify(note)
    with StopRequest() as stop:
        metrics = _measure(cfg, builder, policy, request, checkpoint, stop)
    if metrics is None:
        return stop.exit_code
    kinds = ("deterministic",) if request.deterministic else ("sampled", "deterministic")
    Console().print(metrics_table(cfg, metrics, frames, kinds, builder.mdp.start.source))
    print(f"checkpoint: {checkpoint} ({frames:,} frames)")
    if request.video:
        env = builder.make(1, 1, cfg.seed, "eval", auto_reset=False)
        path = run_dir / "videos" / f"eval_{checkpoint.stem}.mp4"
        film_policy(env, lambda obs: policy.act(obs, deterministic=True), path)
        print(f"video:      {path}")
    return 0


def _measure(
    cfg: ExperimentCfg,
    builder: EnvBuilder,
    policy: ActorCritic | SquashedPolicy,
    request: EvalRequest,
    checkpoint: Path,
    stop: StopRequest,
) -> dict[str, float] | None:
    count = threads(cfg)
    episodes = request.episodes or cfg.eval.episodes
    probe = builder.make(1, 1, cfg.seed)
    if (policy.cfg.obs_dim, policy.cfg.action_dim) != (probe.obs_dim, probe.action_dim):
        raise CheckpointError(
            f"{checkpoint} is of a policy with {policy.cfg.obs_dim} observations and "
            f"{policy.cfg.action_dim} actions, task '{cfg.task.id}' has {probe.obs_dim} and "
            f"{probe.action_dim}: it belongs to another run"
        )
    evaluator = Evaluator(
        lambda n: builder.make(n, min(n, count), cfg.seed, "eval"),
        # With the deterministic policy alone the sampled one is not worth its time.
        1 if request.deterministic else episodes,
        episodes if cfg.task.randomize else 1,
        cfg.seed,
    )
    return evaluator.evaluate(policy, stop)


def find_checkpoint(path: Path, best: bool) -> tuple[Path, Path]:
    """Return the run folder and the checkpoint file that a path means.

    Raises:
        RunError: if it is neither a run folder nor a file in one.
        CheckpointError: if the run has no checkpoint yet.
    """
    if path.is_file():
        for folder in path.absolute().parents[:2]:
            if (folder / FILE).is_file():
                return folder, path
        raise RunError(f"'{path}' lies in no run folder: no {FILE} beside it or one level up")
    if not path.is_dir():
        raise RunError(f"there is no run folder or checkpoint '{path}'; pgdm runs lists the runs")
    if not (path / FILE).is_file():
        raise RunError(f"'{path}' holds no run: it has no {FILE}; pgdm runs lists the runs")
    checkpoints = CheckpointFolder(path / "checkpoints", keep_last=1)
    if best and checkpoints.best.is_file():
        return path, checkpoints.best
    newest = checkpoints.newest()
    if newest is None:
        raise CheckpointError(f"'{path}' has no checkpoint yet; start its command again")
    return path, newest[0]
