"""``pgdm eval``: measure a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from pgdm.cli.console.screen import bars, console, notify
from pgdm.cli.console.summary import metrics_table
from pgdm.cli.policies import PolicyRequest, open_policy
from pgdm.envs.film import film_policy
from pgdm.export.measure import measure
from pgdm.stop import StopRequest


@dataclass(frozen=True)
class EvalRequest:
    """What to measure, and how."""

    policy: PolicyRequest
    """Which policy."""
    episodes: int | None
    """Number of sampled episodes and, if the task is randomised, of deterministic ones; None: as in
    the run."""
    video: bool
    """Whether to make a video of one deterministic episode as well."""
    deterministic: bool
    """Whether to report only the episodes with the policy's mean action."""
    seed: int | None
    """Seed of the action noise and the task's own randomness; None: the run's."""
    offline: bool
    """Whether missing assets are an error instead of being fetched."""


def evaluate_policy(request: EvalRequest) -> int:
    """Print a policy's metrics and return the exit code.

    The code is 1 if a stored result is not reproduced, that of a stop signal if one arrived,
    otherwise 0. A stored result is compared only if episodes, seed and ``deterministic`` are left
    at their defaults.

    Raises:
        PgdmError: if the policy is missing or damaged, or does not fit its environment.
    """
    policy = open_policy(request.policy)
    cfg = policy.cfg
    if request.seed is not None:
        cfg = replace(cfg, seed=request.seed)
    policy = replace(policy, cfg=replace(cfg, offline=request.offline or cfg.offline))
    with bars() as progress:
        builder = policy.builder(notify, progress)
    with StopRequest() as stop, bars() as progress:
        metrics = measure(policy, builder, progress, stop, request.episodes, request.deterministic)
    if metrics is None:
        return stop.exit_code
    kinds = ("deterministic",) if request.deterministic else ("sampled", "deterministic")
    start = builder.mdp.start.source
    console().print(metrics_table(cfg, metrics, policy.frames, kinds, start))
    print(f"policy: {policy.name} ({policy.frames:,} frames)")
    if request.video:
        env = builder.make(1, 1, cfg.seed, "eval", auto_reset=False)
        notify("drawing the video")
        film_policy(env, lambda obs: policy.network.act(obs, deterministic=True), policy.video)
        print(f"video:  {policy.video}")
    asked = request.episodes, request.seed, request.deterministic
    if policy.evaluation and asked == (None, None, False):
        return _compared(policy.evaluation, metrics)
    return 0


def _compared(stored: Mapping[str, float], now: Mapping[str, float]) -> int:
    """Print whether metrics are the stored ones, and return the exit code."""
    # Metrics that do not apply are NaN, and are not stored.
    changed = [name for name, value in stored.items() if now.get(name) != value]
    if not changed:
        print(f"stored result: reproduced, all {len(stored)} numbers are bit-identical")
        return 0
    success = "eval_sampled/success"
    print(
        f"stored result: not reproduced, {len(changed)} of {len(stored)} numbers differ; sampled "
        f"success was {stored.get(success, float('nan')):.2%}, is now {now[success]:.2%}"
    )
    return 1
