"""Try to learn in fewer frames: hypothesis, command and outcome of every experiment.

    python benchmark/experiments.py               train what is missing, then write the table
    python benchmark/experiments.py fast kernel   only these
    python benchmark/experiments.py --collect     write the table of the stored results

Each experiment changes `+experiment=fast` and runs on the suite `tune6`, which shares no task with
`quick6`, the suite on which the kept changes are confirmed. A stored run is trained again if its
settings have changed since. Two runs train at a time, one thread each.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from short_runs import Job, curves, finished, train_all

from pgdm.config.compose import compose
from pgdm.config.identity import identity_hash
from pgdm.config.saved import load_config
from pgdm.config.suites import suite
from pgdm.runs.files import CONFIG, read_json, write_json
from pgdm.runs.folder import RunFolder

RESULTS = Path(__file__).parent / "results" / "experiments"
TUNE6 = suite("tune6")
FRAMES = 75_000
COMMON = (
    "+experiment=fast",
    f"total_frames={FRAMES}",
    "eval.interval_frames=25000",
    "eval.video=false",
)
CURVES = ("success", "lifted", "return", "com_error")


@dataclass(frozen=True)
class Experiment:
    """A change, and why it might help."""

    name: str
    hypothesis: str
    overrides: tuple[str, ...]
    kept: str
    """Whether it became part of `+experiment=fast`, or why not."""
    seeds: tuple[int, ...] = (0,)


EXPERIMENTS = (
    Experiment("fast", "the settings that were kept", (), "yes"),
    Experiment(
        "no-shaping",
        "without a reward gradient far from the target, objects are held off their path",
        ("shaping=none",),
        "yes: soft end",
    ),
    Experiment(
        "no-grasp-term",
        "without a reward for fingertips that stay on the object, it is pinched or never lifted",
        ("shaping=soft_end",),
        "yes: grasp",
    ),
    Experiment(
        "world-frame",
        "in world-frame poses a centimetre is hardly seen",
        ("obs=released",),
        "yes: relative",
    ),
    Experiment(
        "kernel",
        "the wide tracking term, 5 exp(-10 e), gives a reward gradient everywhere",
        ("shaping.kernel_weight=5",),
        "",
    ),
    Experiment(
        "kernel-alone",
        "the wide tracking term is enough, without the soft end",
        ("shaping.soft_end_m=null", "shaping.kernel_weight=5"),
        "",
    ),
    Experiment(
        "soft-end-30cm",
        "a gentler soft end leaves more to explore for",
        ("shaping.soft_end_m=0.3",),
        "",
    ),
    Experiment(
        "unplanned",
        "a path sent unmodified is followed late and with overshoot",
        ("action.wrist_path=clipped",),
        "yes: planned",
    ),
    Experiment("no-hold", "fingers need time to close", ("action.hold_steps=0",), "yes: held"),
    Experiment("no-load", "weight pulls the base down", ("action.carry_load=false",), "yes: borne"),
    Experiment(
        "cool",
        "with a tenth of the initial temperature, contact is found sooner",
        ("algo.temperature_init=0.0005",),
        "",
    ),
    Experiment("far-sighted", "tools need a longer horizon", ("algo.gamma=0.98",), ""),
    Experiment(
        "half-the-updates",
        "two updates per step cost half the time",
        ("algo.updates_per_step=2",),
        "",
    ),
)


def identity_of(job: Job) -> str:
    """Return the hash of all settings that affect a run's result."""
    return identity_hash(compose([f"task={job.task}", *job.overrides, f"seed={job.seed}"]))


def current(job: Job) -> bool:
    """Return whether the stored result has today's settings and length."""
    one = read_json(RESULTS / f"{job.name}.json")
    return one.get("identity") == identity_of(job) and one["frames"] >= FRAMES


def collect(run: Path, job: Job) -> dict[str, Any] | None:
    """Return settings and curves of a finished run, or None if it has not finished."""
    result = finished(run)
    if result is None or identity_hash(load_config(run)) != identity_of(job):
        return None
    names = [f"{kind}/{n}" for kind in ("eval_sampled", "eval_deterministic") for n in CURVES]
    about: dict[str, Any] = {"task": job.task, "setting": job.setting, "seed": job.seed}
    about["identity"] = identity_of(job)
    about |= {"overrides": list(job.overrides), "curves": curves(run, "eval", names)}
    return about | {key: result[key] for key in ("frames", "wall_time_s", "git", "versions")}


def make_way(run: Path, job: Job) -> None:
    """Rename a run's folder if its settings differ, since the job could not be resumed in it."""
    if not (run / CONFIG).exists() or RunFolder(run).busy:
        return
    if (old := identity_hash(load_config(run))) != identity_of(job):
        run.rename(run.with_name(f"{run.name}-{old}-{run.stat().st_mtime:.0f}"))


def last(one: dict[str, Any], name: str) -> float:
    """Return a metric at the end of a run, 0 if it does not apply."""
    return one["curves"][name][-1] or 0.0


def table(stored: dict[str, list[dict[str, Any]]]) -> str:
    """Return all experiments as a Markdown table, means over tasks and seeds."""
    lines = [
        "| experiment | hypothesis | change | runs | success, sampled | deterministic | return "
        f"| lifted | {' | '.join(TUNE6)} | kept |",
        "|---|---|---|--:|--:|--:|--:|--:|" + "--:|" * len(TUNE6) + "---|",
    ]
    for e in EXPERIMENTS:
        runs = stored.get(e.name, [])
        if not runs:
            continue
        shown = [
            f"{mean(last(r, 'eval_sampled/success') for r in runs):.1%}",
            f"{mean(last(r, 'eval_deterministic/success') for r in runs):.1%}",
            f"{mean(last(r, 'eval_sampled/return') for r in runs):.0f}",
            f"{mean(last(r, 'eval_sampled/lifted') for r in runs):.0%}",
        ]
        for task in TUNE6:
            own = [last(r, "eval_sampled/success") for r in runs if r["task"] == task]
            shown.append(f"{mean(own):.1%}" if own else "-")
        change = " ".join(f"`{text}`" for text in e.overrides) or "none"
        lines.append(
            f"| {e.name} | {e.hypothesis} | {change} | {len(runs)} | {' | '.join(shown)} "
            f"| {e.kept or 'no'} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Train, collect, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="which experiments [all]")
    parser.add_argument("--runs", type=Path, default=Path("runs/experiments"))
    parser.add_argument("--collect", action="store_true", help="do not train")
    options = parser.parse_args()
    known = [e.name for e in EXPERIMENTS]
    if wrong := [name for name in options.names if name not in known]:
        parser.error(f"no experiment '{wrong[0]}'; there are: {', '.join(known)}")
    RESULTS.mkdir(parents=True, exist_ok=True)
    stored: dict[str, list[dict[str, Any]]] = {}
    for e in EXPERIMENTS:
        jobs = [
            Job(task, e.name, (*COMMON, *e.overrides), seed) for seed in e.seeds for task in TUNE6
        ]
        missing = [job for job in jobs if not current(job)]
        if not options.collect and e.name in (options.names or known):
            for job in missing:
                make_way(options.runs / job.name, job)
            train_all(options.runs, missing)
        for job in missing:
            one = collect(options.runs / job.name, job)
            if one is not None:
                write_json(RESULTS / f"{job.name}.json", one)
        stored[e.name] = [read_json(RESULTS / f"{job.name}.json") for job in jobs if current(job)]
        if any(stored.values()):
            page = f"# {FRAMES:,} frames of tune6\n\n`python benchmark/experiments.py`\n\n"
            (RESULTS / "README.md").write_text(page + table(stored))
    print(table(stored))


if __name__ == "__main__":
    main()
