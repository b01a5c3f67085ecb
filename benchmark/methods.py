"""Check whether the methods' reward terms have an effect, in short runs on three tasks.

    python benchmark/methods.py                  train what is missing, then collect
    python benchmark/methods.py --collect        collect only
    python benchmark/methods.py --frames 8192 --tasks cup-pour1 --out /tmp/try     a short trial

Questions: does the hand come closer to the expert's with DeepMimic than without; do fingertips come
closer to the contact points with GRAFF*; does the curriculum's weight follow its ramp; does a hand
that starts at its reset pose touch the object at all. PGDM is trained with the expert's terms at
weight 0, so that the same metrics are measured. Each run is an ordinary `pgdm-run`: the same
command resumes it. Values are means over the 25 episodes of an evaluation, actions sampled.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import mujoco
import torch
from short_runs import Job, curves, finished, train_all

from pgdm.config.saved import load_config
from pgdm.experiment import assets, env_builder
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint
from pgdm.rl.evaluate import policy_of
from pgdm.seeding import torch_stream
from pgdm.sim.contact import FingertipDistance

RESULTS = Path(__file__).parent / "results" / "methods"
TASKS = ("hammer-use1", "cup-pour1", "spheremedium-lift")
FRAMES = 200_000
# The curriculum's weight reaches its final value in the middle of the run.
RAMP_SHARE = 0.5
TRACKING_WEIGHT = 10.0
EVALUATIONS = 5
TOUCH_M, TOUCH_EPISODES = 0.001, 8

MEASURED = (
    "method=full",
    "method.curriculum=null",
    "method.imitation.weight=0",
    "method.imitation.max_hand_error=null",
    "method.contact.weight=0",
)
LEARNER = ("algo=ppo_fast", "action=residual", "seed=0", "eval.video=false")
HAND, CONTACT = "hand_error_m", "contact_distance_m"
WEIGHT = "train/weight/tracking"
TRAINED = (
    f"train/{HAND}",
    "train/hand_error_rad",
    f"train/{CONTACT}",
    "train/end/hand_lost",
    "train/length",
    WEIGHT,
)
EVALUATED = tuple(
    f"eval_sampled/{name}"
    for name in (HAND, "hand_error_rad", CONTACT, "end/hand_lost", "length", "lifted", "success")
)


def settings(frames: int) -> dict[str, tuple[str, ...]]:
    """Return the overrides of each setting."""
    ramp = f"method.curriculum.ramp_frames={round(frames * RAMP_SHARE)}"
    return {
        "pgdm": MEASURED,
        "deepmimic": ("method=deepmimic",),
        "graff": ("method=graff",),
        "curriculum": ("method=curriculum", ramp),
        "pgdm-without-pregrasp": (*MEASURED, "pregrasp=none"),
    }


def collect(run: Path, job: Job) -> dict[str, Any] | None:
    """Return the curves of a finished run, or None if it has not finished."""
    result = finished(run)
    if result is None:
        return None
    return {
        "task": job.task,
        "setting": job.setting,
        "overrides": list(job.overrides),
        "train": _without_empty(curves(run, "train", TRAINED)),
        "eval": _without_empty(curves(run, "eval", EVALUATED)),
        "touched": touched(run),
        **{key: result[key] for key in ("frames", "steps_per_s", "versions", "git")},
    }


def touched(run: Path) -> float:
    """Return the share of steps at which a fingertip touches the object, final policy, sampled."""
    cfg = load_config(run)
    builder = env_builder(cfg, assets(cfg, print))
    newest = CheckpointFolder(run / "checkpoints", keep_last=1).newest()
    assert newest is not None  # the run has finished
    policy, noise = policy_of(read_checkpoint(newest[0]), newest[0]), torch_stream(cfg.seed, "eval")
    env = builder.make(TOUCH_EPISODES, 1, cfg.seed, "eval")
    model = builder.scene.model
    data, distance = mujoco.MjData(model), FingertipDistance(builder.scene)
    obs, waiting = env.reset(), torch.ones(TOUCH_EPISODES, dtype=torch.bool)
    steps, touching = 0, 0
    while waiting.any():
        obs, _, terminated, truncated, info = env.step(policy.act(obs, noise))
        for row in waiting.nonzero()[:, 0].tolist():
            data.qpos[:] = info["qpos"][row].numpy()
            mujoco.mj_kinematics(model, data)
            steps += 1
            touching += int(distance(data).min() < TOUCH_M)
        waiting &= ~(terminated | truncated)
    return round(touching / steps, 3)


def _without_empty(curve: dict[str, list[float | None]]) -> dict[str, list[float | None]]:
    return {name: v for name, v in curve.items() if any(one is not None for one in v)}


def off_the_line(run: dict[str, Any]) -> float:
    """Return the largest deviation of a curriculum's recorded weight from its ramp."""
    curve, frames = run["train"], run["train"]["frames"]
    ramp = next(int(o.split("=")[1]) for o in run["overrides"] if "ramp_frames" in o)
    starts = [0, *frames[:-1]]  # an iteration's weight is that of its first frame
    line = [TRACKING_WEIGHT * min(1.0, start / ramp) for start in starts]
    return max(abs(a - b) for a, b in zip(curve[WEIGHT], line, strict=True))


def table(found: Sequence[dict[str, Any]]) -> str:
    """Return the answers as a Markdown table: first evaluation to last."""
    head = (
        "| task | setting | fingertips from the expert's [cm] | from its contact points [cm] "
        "| lifted | length [steps] | episodes ended by the hand | steps that touch the object "
        "| weight off its line |\n|---|---|--:|--:|--:|--:|--:|--:|--:|\n"
    )
    return head + "".join(_row(run) for run in found)


def _row(run: dict[str, Any]) -> str:
    cells = [run["task"], run["setting"]]
    for name, unit, form in (
        (HAND, 100, ".1f"), (CONTACT, 100, ".1f"), ("lifted", 1, ".0%"), ("length", 1, ".0f"),
        ("end/hand_lost", 1, ".0%"),
    ):  # fmt: skip
        curve = run["eval"].get(f"eval_sampled/{name}")
        first_last = (curve[0], curve[-1]) if curve else ()
        ends = ["-" if v is None else format(unit * v, form) for v in first_last]
        cells.append(" to ".join(ends) or "-")
    cells.append(f"{run['touched']:.0%}")
    cells.append(f"{off_the_line(run):.1e}" if WEIGHT in run["train"] else "-")
    return f"| {' | '.join(cells)} |\n"


def plot(found: Sequence[dict[str, Any]], tasks: Sequence[str], path: Path) -> None:
    """Draw the metric of each term over frames: a column per task, a line per setting."""
    panels = (
        ("eval", f"eval_sampled/{HAND}", "fingertips from\nthe expert's [m]"),
        ("eval", f"eval_sampled/{CONTACT}", "fingertips from\ncontact points [m]"),
        ("train", WEIGHT, "weight of tracking"),
        ("eval", "eval_sampled/lifted", "lifted"),
    )
    names = list(dict.fromkeys(run["setting"] for run in found))
    figure, axes = plt.subplots(
        len(panels), len(tasks), figsize=(max(8, 4.2 * len(tasks)), 9), sharex=True
    )
    axes = axes.reshape(len(panels), len(tasks))
    for column, task in enumerate(tasks):
        axes[0][column].set_title(task)
        for row, (kind, name, label) in enumerate(panels):
            axis = axes[row][column]
            axis.set_ylabel(label if column == 0 else "")
            for run in (run for run in found if run["task"] == task and name in run[kind]):
                color = f"C{names.index(run['setting'])}"
                frames = [count / 1000 for count in run[kind]["frames"]]
                axis.plot(frames, run[kind][name], color, label=run["setting"])
            axis.set_ylim(0, 1 if label == "lifted" else None)
        axes[-1][column].set_xlabel("thousand frames")
    handles = {h.get_label(): h for a in axes.flat for h in a.get_lines()}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=3)
    figure.suptitle("One seed, ppo_fast, residual actions; means of 25 sampled episodes")
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.savefig(path, dpi=80)


def main() -> None:
    """Train, collect, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/methods"))
    parser.add_argument("--collect", action="store_true", help="do not train")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the curves")
    options = parser.parse_args()
    length = (
        f"total_frames={options.frames}",
        f"eval.interval_frames={options.frames // EVALUATIONS}",
    )
    jobs = [
        Job(task, setting, (*length, *LEARNER, *overrides))
        for task in options.tasks
        for setting, overrides in settings(options.frames).items()
    ]
    if not options.collect:
        train_all(options.runs, jobs)
    options.out.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        one = collect(options.runs / job.name, job)
        if one is not None:
            (options.out / f"{job.name}.json").write_text(json.dumps(one) + "\n")
    stored = [options.out / f"{job.name}.json" for job in jobs]
    found = [json.loads(file.read_text()) for file in stored if file.exists()]
    (options.out / "README.md").write_text(
        f"# {len(found)} of {len(jobs)} runs of {options.frames:,} frames\n\n"
        f"`python benchmark/methods.py`\n\n{table(found)}"
    )
    plot(
        found,
        [t for t in options.tasks if any(run["task"] == t for run in found)],
        options.out / "curves.png",
    )
    print(table(found))


if __name__ == "__main__":
    main()
