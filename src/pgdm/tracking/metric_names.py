"""The meaning of each logged metric, as one table for MLflow's descriptions and the docs."""

from __future__ import annotations

import textwrap
from typing import NamedTuple


class Metric(NamedTuple):
    """One metric."""

    name: str
    """Name without its group."""
    groups: str
    """``train``, ``eval`` or ``both``."""
    unit: str
    meaning: str


METRICS = (
    Metric("success", "both", "0..1", "share of steps with the object within 1 cm of its target"),
    Metric(
        "com_error", "both", "m", "mean distance of the object's centre of mass from its target"
    ),
    Metric(
        "com_error_released",
        "both",
        "m",
        "error as the released code computes it and the paper shows it: Frobenius norm of the "
        "differences from the targets, divided by T-1",
    ),
    Metric("ori_error", "both", "rad", "mean angle between object and target orientation"),
    Metric(
        "lifted",
        "both",
        "0..1",
        "of the steps whose target is 2 cm or more above the object's start, the share in which "
        "the object is too",
    ),
    Metric(
        "dropped",
        "both",
        "0..1",
        "share of episodes in which the object was lifted by 2 cm and later fell below that while "
        "its target was above it",
    ),
    Metric("length", "both", "steps", "control steps until the episode ended"),
    Metric(
        "return", "both", "reward", "sum of the task's rewards over an episode, without shaping"
    ),
    Metric("shaping", "train", "reward", "sum of the rewards that shaping=... adds in training"),
    Metric("raw/<name>", "both", "-", "sum of a reward term over the episode, before weighting"),
    Metric("term/<name>", "both", "reward", "contribution of a weighted reward term to the return"),
    Metric("end/<name>", "both", "0..1", "share of episodes that the termination `<name>` ended"),
    Metric(
        "hand_error_m", "both", "m", "mean distance of fingertips from the expert's, over the steps"
    ),
    Metric(
        "hand_error_rad",
        "both",
        "rad",
        "mean difference of wrist and finger joints from the expert's",
    ),
    Metric(
        "contact_distance_m",
        "both",
        "m",
        "mean distance of fingertips from the expert's contact points, while the expert touches "
        "the object",
    ),
    Metric("diverged", "both", "0..1", "share of episodes that ended in a diverged simulation"),
    Metric(
        "<name>_std",
        "eval",
        "as `<name>`",
        "standard deviation over the episodes, if there are several",
    ),
    Metric("episodes", "train", "episodes", "episodes that ended in the iteration"),
    Metric(
        "reward",
        "train",
        "reward",
        "mean reward per step, shaping included (`return` excludes it)",
    ),
    Metric("weight/<name>", "train", "-", "weight of a reward term that has a schedule"),
    Metric("steps_per_s", "train", "1/s", "frames per second, learning included"),
    Metric("loss_policy", "train", "-", "policy loss: PPO's clipped objective or SAC's"),
    Metric("loss_critic", "train", "-", "SAC: squared errors of the critics, summed"),
    Metric("temperature", "train", "-", "SAC: weight of the entropy in the return"),
    Metric("loss_value", "train", "reward^2", "squared error of the value, unweighted"),
    Metric("entropy", "train", "nat", "entropy of the action distribution"),
    Metric("kl", "train", "nat", "approximate KL divergence from the policy before its update"),
    Metric("clip_fraction", "train", "0..1", "share of samples whose ratio was clipped"),
    Metric(
        "explained_variance",
        "train",
        "<=1",
        "share of the returns' variance that the value explains",
    ),
    Metric("ess", "train", "0..1", "effective sample size of the importance weights, as a share"),
    Metric("grad_norm", "train", "-", "norm of the gradient before clipping"),
    Metric(
        "action_std", "train", "-", "mean standard deviation of the actions, whose range is -1..1"
    ),
    Metric("lr", "train", "-", "learning rate"),
)


def markdown() -> str:
    """Return the table in Markdown: metric, unit, meaning, groups."""
    groups = {
        "train": "`train/`",
        "eval": "`eval_*/`",
        "both": "`train/`, `eval_sampled/`, `eval_deterministic/`",
    }
    rows = "\n".join(
        f"| `{m.name}` | {m.unit} | {m.meaning} | {groups[m.groups]} |" for m in METRICS
    )
    about = (
        "The step of every metric is in frames: control steps, summed over all simulations. "
        "`train/` covers the episodes that ended in an iteration; `eval_sampled/` draws actions "
        "(as the paper does), `eval_deterministic/` takes the mean action."
    )
    return (
        f"{textwrap.fill(about, 120)}\n\n"
        f"| metric | unit | meaning | groups |\n|---|---|---|---|\n{rows}\n"
    )
