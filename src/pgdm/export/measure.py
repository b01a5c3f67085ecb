"""Evaluation of a trained policy, as during its training."""

from __future__ import annotations

from collections.abc import Callable

from pgdm.envs.build import EnvBuilder
from pgdm.experiment import threads
from pgdm.export.trained import TrainedPolicy
from pgdm.library.progress import StepProgress
from pgdm.rl.evaluate import Evaluator


def measure(
    policy: TrainedPolicy,
    builder: EnvBuilder,
    progress: StepProgress,
    stop: Callable[[], bool] = lambda: False,
    episodes: int | None = None,
    deterministic: bool = False,
) -> dict[str, float] | None:
    """Return a policy's metrics, see `Evaluator.evaluate`; None if it was stopped.

    Args:
        policy: the policy; its ``cfg.seed`` seeds the action noise and the task's randomisation.
        builder: builder of the policy's task.
        progress: called with the control steps done.
        stop: polled before each step; True stops.
        episodes: number of sampled episodes and, if the task is randomised, of deterministic ones;
            None: as in the evaluations during training.
        deterministic: whether only the deterministic metrics are needed; the sampled ones are then
            of a single episode.
    """
    cfg = policy.cfg
    count, wanted = threads(cfg), episodes or cfg.eval.episodes
    evaluator = Evaluator(
        lambda n: builder.make(n, min(n, count), cfg.seed, "eval"),
        # The evaluator always runs sampled episodes; one is enough if they are not needed.
        1 if deterministic else wanted,
        wanted if cfg.task.randomize else 1,
        cfg.seed,
    )
    steps, most = 0, 2 * (len(builder.mdp.reference) - 1)  # sampled and deterministic

    def stepped() -> bool:
        nonlocal steps
        progress("evaluation", steps, most)
        steps += 1
        return stop()

    return evaluator.evaluate(policy.network, stepped)
