"""Compare `+experiment=fast` with other settings on six varied tasks; store results and curves.

    python benchmark/learning.py                    train what is missing, then collect
    python benchmark/learning.py --frames 300000    train for fewer frames; a later call resumes
                                                    (a run started as longer is trained to its end)
    python benchmark/learning.py --settings ppo_fast-planned --tasks hammer-use1
    python benchmark/learning.py --collect          collect only, also from running runs

The runs of `+experiment=fast` itself are those that tcdm50.py has stored. The other settings,
each the same for all tasks and all with `shaping.beyond_plan=false`: `fast-limit-1` limits the
policy's mean before tanh more, and `fast-unlimited` not at all;
`fast-earlier` has the released observation, linear corrections, uncorrelated noise, and neither
an average nor a reward for the grasp; `fast-clipped` and `fast-feasible` are the same with another
wrist path; `ppo_fast-planned` is `+experiment=fast` with another learner, `algo=ppo_fast`;
`ppo_fast-residual` has the carried wrist path, the released observation and no shaping; and
`ppo-absolute` is the paper's PPO with its actions. Each run is an ordinary `pgdm-run`: the same
command resumes it. Two runs train at a time, one thread each.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import tcdm50
from short_runs import Job, curves, train_all

from pgdm.config.compose import compose
from pgdm.config.saved import load_config
from pgdm.config.suites import suite
from pgdm.experiment import assets, env_builder
from pgdm.runs.files import CONFIG, LOG, RESULT, read_json, write_json
from pgdm.runs.log import RunLog, metrics_of

RESULTS = Path(__file__).parent / "results" / "learning"
FRAMES = 1_000_000
EARLY = 300_000
"""The table also shows success after this many frames."""

HALF = 0.5
QUICK6 = suite("quick6")
WHOLE_ERROR = "shaping.beyond_plan=false"
EARLIER = (
    "+experiment=fast",
    WHOLE_ERROR,
    "eval.interval_frames=50000",
    "obs=released",
    "shaping=soft_end",
    "action.residual_power=1",
    "algo.noise_correlation=0",
    "algo.average_rate=0",
    "algo.pre_tanh_limit=null",
)
SETTINGS = {
    "fast": ("+experiment=fast",),
    "fast-limit-1": ("+experiment=fast", WHOLE_ERROR, "algo.pre_tanh_limit=1"),
    "fast-unlimited": ("+experiment=fast", WHOLE_ERROR, "algo.pre_tanh_limit=null"),
    "fast-earlier": EARLIER,
    "fast-clipped": (*EARLIER, "action.wrist_path=clipped"),
    "fast-feasible": (*EARLIER, "action.wrist_path=feasible"),
    "ppo_fast-planned": (
        "algo=ppo_fast",
        "obs=relative",
        "shaping=grasp",
        WHOLE_ERROR,
        "action=residual",
        "action.residual_power=2",
        "action.wrist_path=planned",
        "action.hold_steps=3",
        "action.carry_load=true",
        "eval.interval_frames=100000",
    ),
    "ppo_fast-residual": ("algo=ppo_fast", "action=residual", "eval.interval_frames=100000"),
    "ppo-absolute": ("algo=ppo", "action=absolute", "eval.interval_frames=100000"),
}
SEEDS = {s: (0, 1, 2) if s in ("fast", "fast-unlimited") else (0,) for s in SETTINGS}
TRAINED = [setting for setting in SETTINGS if setting != "fast"]
COMMON = ("eval.video_every_eval=false", "keep_replay=true")
CURVES = ("success", "lifted", "return", "com_error")
KINDS = ("eval_sampled", "eval_deterministic")


def collect(run: Path, job: Job) -> dict[str, Any] | None:
    """Return the progress of a run and its latest metrics, or None if it has not started."""
    curve = curves(run, "eval", [f"{kind}/{name}" for kind in KINDS for name in CURVES])
    frames = curve.pop("frames")
    if not frames:
        return None
    cfg, result = load_config(run), read_json(run / RESULT)
    last = [line for line in RunLog(run / LOG).read() if line["kind"] == "eval"][-1]
    return {
        "task": job.task,
        "setting": job.setting,
        "seed": job.seed,
        "overrides": list(job.overrides),
        "paper_success": cfg.task.paper_success,
        "paper_com_error": cfg.task.paper_com_error,
        "curve_frames": frames,
        "curve_minutes": curve.pop("minutes"),
        "curves": curve,
        "frames": frames[-1],
        "wall_time_s": round(float(last["time_s"]), 1),
        "metrics": metrics_of(last),
        **{
            k: result[k]
            for k in ("scene_sha256", "motion_sha256", "git", "versions")
            if k in result
        },
    }


def stored(job: Job) -> dict[str, Any]:
    """Return the stored result of a run; empty if there is none."""
    if job.setting in TRAINED:
        return read_json(RESULTS / f"{job.name}.json")
    run = tcdm50.place(job.task, job.seed or 0)
    found = (run / CONFIG).is_file() and tcdm50.current(load_config(run))
    return (collect(run, job) or {}) if found else {}


def store(job: Job, one: dict[str, Any]) -> None:
    """Store the result of a run, unless one with more frames is stored."""
    if one["frames"] >= stored(job).get("frames", 0):
        write_json(RESULTS / f"{job.name}.json", one)


def to_train(runs: Path, job: Job, frames: int) -> Job | None:
    """Return a job with its length, or None if a result with that many frames is stored."""
    if stored(job).get("frames", 0) >= frames:
        return None
    run = runs / job.name
    begun = load_config(run).total_frames if (run / CONFIG).exists() else 0
    # The length of a run may only grow.
    return replace(job, overrides=(*job.overrides, f"total_frames={max(frames, begun)}"))


def scene_now(task: str) -> str:
    """Return the hash of a task's scene as it is compiled today."""
    cfg = compose([f"task={task}"])
    return str(env_builder(cfg, assets(cfg, print)).facts()["scene_sha256"])


def with_old_scenes(found: list[dict[str, Any]], scenes: dict[str, str]) -> list[dict[str, Any]]:
    """Return results with ``old_scene``, whether the scene has changed since.

    Args:
        found: the results; one without a scene hash counts as current.
        scenes: hash of each task's scene today.
    """
    return [
        r | {"old_scene": r.get("scene_sha256", scenes[r["task"]]) != scenes[r["task"]]}
        for r in found
    ]


def at(one: dict[str, Any], name: str, frames: int) -> float | None:
    """Return a metric at a run's first evaluation after ``frames`` frames, or None."""
    for when, value in zip(one["curve_frames"], one["curves"][name], strict=True):
        if when >= frames:
            return value
    return None


def table(found: list[dict[str, Any]]) -> str:
    """Return the results as a Markdown table, next to the paper's."""
    head = (
        f"| task | setting | seed | success at {EARLY:,} frames, sampled | deterministic "
        "| frames | minutes | success, sampled | deterministic | lifted, sampled "
        "| COM error, released form [m] | paper: success | paper: error [m] |\n"
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n"
    )
    rows = []
    for r in found:
        m, task = r["metrics"], f"{r['task']} (old scene)" if r["old_scene"] else r["task"]
        early = [at(r, f"{kind}/success", EARLY) for kind in KINDS]
        shown = [*early, *(m[f"{kind}/success"] for kind in KINDS), m.get("eval_sampled/lifted")]
        cells = ["-" if value is None else f"{value:.1%}" for value in shown]
        rows.append(
            f"| {task} | {r['setting']} | {r['seed']} | {' | '.join(cells[:2])} "
            f"| {r['frames']:,} | {r['wall_time_s'] / 60:.0f} | {' | '.join(cells[2:])} "
            f"| {m['eval_sampled/com_error_released']:.2e} | {r['paper_success']:.1%} "
            f"| {r['paper_com_error']:.2e} |\n"
        )
    return head + "".join(rows)


def means(found: list[dict[str, Any]]) -> str:
    """Return each setting's mean over the tasks and seeds that have come so far.

    Runs in a scene that has changed since are left out.
    """
    lines = []
    for setting in SETTINGS:
        for frames in (EARLY, FRAMES):
            values = [
                (r["task"], value)
                for r in found
                if r["setting"] == setting
                and not r["old_scene"]
                and (value := at(r, "eval_sampled/success", frames)) is not None
            ]
            if values:
                mean = sum(value for _, value in values) / len(values)
                tasks = sorted({task for task, _ in values})
                lines.append(
                    f"- {setting}: sampled success {mean:.1%} at {frames:,} frames, mean of "
                    f"{len(values)} runs, tasks: {', '.join(tasks)}\n"
                )
    return "".join(lines)


def minutes(found: list[dict[str, Any]]) -> str:
    """Return each setting's minutes to half success, run by run, as a Markdown table."""
    lines = [
        f"Minutes until the sampled policy first has {HALF:.0%} success, one value a seed; two "
        "runs at a time on two cores, one thread each:\n",
        f"| setting | {' | '.join(QUICK6)} |",
        f"|---|{'--:|' * len(QUICK6)}",
    ]
    for setting in SETTINGS:
        timed = [r for r in found if r["setting"] == setting and "curve_minutes" in r]
        cells = [", ".join(to_half(r) for r in timed if r["task"] == task) for task in QUICK6]
        if timed:
            lines.append(f"| {setting} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def to_half(one: dict[str, Any]) -> str:
    """Return the minutes until a run first has half success, or that it never has it."""
    for when, success in zip(
        one["curve_minutes"], one["curves"]["eval_sampled/success"], strict=True
    ):
        if success >= HALF:
            return f"{when:.1f}"
    return f"not in {one['curve_minutes'][-1]:.0f}"


def remarks(found: list[dict[str, Any]]) -> str:
    """Return notes on the table and the picture."""
    lines = []
    if any(r["old_scene"] for r in found):
        lines.append(
            "Old scene: trained before the task's scene was corrected, and in no mean; to train it "
            "again, remove the stored file.\n\n"
        )
    if untimed := sum("curve_minutes" not in r for r in found):
        lines.append(
            f"{untimed} of the runs were stored without times; the curves over minutes lack "
            "them.\n\n"
        )
    return "".join(lines)


def plot(found: list[dict[str, Any]], path: Path) -> None:
    """Draw success and lift, over frames and over minutes, a panel a task and a line a run."""
    rows = [
        ("eval_sampled/success", "curve_frames"),
        ("eval_sampled/success", "curve_minutes"),
        ("eval_sampled/lifted", "curve_frames"),
    ]
    figure, axes = plt.subplots(len(rows), len(QUICK6), figsize=(18, 8), squeeze=False)
    for column, task in enumerate(QUICK6):
        for row, (name, along) in enumerate(rows):
            axis, labels = axes[row][column], set()
            for r in (r for r in found if r["task"] == task and along in r):
                setting = r["setting"]
                color = f"C{list(SETTINGS).index(setting)}"
                label = None if setting in labels else setting
                labels.add(setting)
                axis.plot(r[along], r["curves"][name], color, label=label)
            axis.set_title(task if row == 0 else "")
            axis.set_ylabel(name.replace("eval_", "").replace("/", " ") if column == 0 else "")
            axis.set_xlabel(along.removeprefix("curve_"))
            axis.set_xlim(0, FRAMES if along == "curve_frames" else None)
            axis.set_ylim(0, 1.02)
    handles = {line.get_label(): line for axis in axes[0] for line in axis.get_lines()}
    shown = [name for name in SETTINGS if name in handles]
    if shown:
        # The door is not lifted: its last panel is free.
        axes[-1][-1].legend([handles[name] for name in shown], shown, fontsize=8, loc="center")
    figure.suptitle("sampled policy, one line a seed (the paper's are after 50,000,000 frames)")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    """Train, collect, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/learning"))
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames to train for")
    parser.add_argument("--settings", nargs="+", choices=TRAINED, default=TRAINED)
    parser.add_argument("--tasks", nargs="+", choices=QUICK6, default=QUICK6)
    parser.add_argument("--collect", action="store_true", help="do not train")
    options = parser.parse_args()
    every = [
        Job(task, setting, (*COMMON, *SETTINGS[setting]), seed)
        for setting in SETTINGS
        for seed in SEEDS[setting]
        for task in QUICK6
    ]
    wanted = [
        longer
        for job in every
        if job.setting in options.settings
        and job.task in options.tasks
        and (longer := to_train(options.runs, job, options.frames)) is not None
    ]
    if not options.collect:
        train_all(options.runs, wanted)
    RESULTS.mkdir(parents=True, exist_ok=True)
    for job in (job for job in every if job.setting in TRAINED):
        one = collect(options.runs / job.name, job)
        if one is not None:
            store(job, one)
    scenes = {task: scene_now(task) for task in QUICK6}
    found = with_old_scenes([one for job in every if (one := stored(job))], scenes)
    (RESULTS / "README.md").write_text(
        f"# {len(found)} of {len(every)} runs\n\n`python benchmark/learning.py`\n\n"
        f"{means(found)}\n{minutes(found)}\n{remarks(found)}{table(found)}"
    )
    plot(found, RESULTS / "curves.png")
    print(means(found), table(found), sep="\n")


if __name__ == "__main__":
    main()
