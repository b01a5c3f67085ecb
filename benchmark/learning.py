"""What pgdm learns in a million frames on six varied tasks; stores results and curves beside it.

    python benchmark/learning.py                 train what is missing, then collect
    python benchmark/learning.py --collect       collect only

Two settings, the same for all tasks: the paper's PPO on the paper's actions, and `algo=ppo_fast
action=residual`. Each run is an ordinary `pgdm-run`, so that stopping and starting again goes on
where it was. Two runs train at a time, one thread each.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from short_runs import Job, curves, finished, train_all

from pgdm.config.saved import load_config
from pgdm.config.suites import suite

RESULTS = Path(__file__).parent / "results" / "learning"
FRAMES = 1_000_000

QUICK6 = suite("quick6")
SETTINGS = {
    "ppo_fast-residual": ("algo=ppo_fast", "action=residual"),
    "ppo-absolute": ("algo=ppo", "action=absolute"),
}
COMMON = (
    f"total_frames={FRAMES}",
    "eval.interval_frames=100000",
    "seed=0",
    "eval.video_every_eval=false",
)
CURVES = ("success", "lifted", "return", "com_error")


def collect(run: Path, job: Job) -> dict[str, Any] | None:
    """Return what a finished run reached and how, or None if it has not finished."""
    result = finished(run)
    if result is None:
        return None
    cfg = load_config(run)
    kinds = ("eval_sampled", "eval_deterministic")
    curve = curves(run, "eval", [f"{kind}/{name}" for kind in kinds for name in CURVES])
    return {
        "task": job.task,
        "setting": job.setting,
        "overrides": list(job.overrides),
        "paper_success": cfg.task.paper_success,
        "paper_com_error": cfg.task.paper_com_error,
        "curve_frames": curve.pop("frames"),
        "curves": curve,
        **result,
    }


def table(found: list[dict[str, Any]]) -> str:
    """Return the results as a Markdown table, the paper's figures beside them."""
    head = (
        "| task | setting | success, sampled | deterministic | COM error, released form [m] "
        "| lifted, deterministic | frames | minutes | paper: success | paper: error [m] |\n"
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|\n"
    )
    rows = []
    for r in found:
        m = r["metrics"]
        lifted = m.get("eval_deterministic/lifted")
        rows.append(
            f"| {r['task']} | {r['setting']} | {m['eval_sampled/success']:.1%} "
            f"| {m['eval_deterministic/success']:.1%} "
            f"| {m['eval_sampled/com_error_released']:.2e} "
            f"| {'-' if lifted is None else f'{lifted:.0%}'} | {r['frames']:,} "
            f"| {r['wall_time_s'] / 60:.0f} | {r['paper_success']:.1%} "
            f"| {r['paper_com_error']:.2e} |\n"
        )
    return head + "".join(rows)


def plot(found: list[dict[str, Any]], path: Path) -> None:
    """Draw success, lift and return over frames, a panel a task and a line a setting."""
    names = ("eval_deterministic/success", "eval_deterministic/lifted", "eval_sampled/return")
    figure, axes = plt.subplots(len(names), len(QUICK6), figsize=(18, 8), squeeze=False)
    for column, task in enumerate(QUICK6):
        for row, name in enumerate(names):
            axis = axes[row][column]
            for r in (r for r in found if r["task"] == task):
                color = f"C{list(SETTINGS).index(r['setting'])}"
                axis.plot(r["curve_frames"], r["curves"][name], color, label=r["setting"])
            axis.set_title(task if row == 0 else "")
            axis.set_ylabel(name.split("/")[1] if column == 0 else "")
            axis.set_xlim(0, FRAMES)
            axis.set_ylim(0, None if "return" in name else 1.02)
    for axis in axes[0]:
        if axis.has_data():
            axis.legend(fontsize=8)
    figure.suptitle(f"{FRAMES:,} frames, one seed (the paper's figures are after 50,000,000)")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    """Train, collect, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/learning"))
    parser.add_argument("--collect", action="store_true", help="do not train")
    options = parser.parse_args()
    jobs = [
        Job(task, setting, (*COMMON, *overrides))
        for setting, overrides in SETTINGS.items()
        for task in QUICK6
    ]
    if not options.collect:
        train_all(options.runs, jobs)
    RESULTS.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        one = collect(options.runs / job.name, job)
        if one is not None:
            (RESULTS / f"{job.name}.json").write_text(json.dumps(one, indent=1) + "\n")
    stored = [RESULTS / f"{job.name}.json" for job in jobs]
    found = [json.loads(file.read_text()) for file in stored if file.exists()]
    (RESULTS / "README.md").write_text(
        f"# {len(found)} of {len(jobs)} runs\n\n`python benchmark/learning.py`\n\n{table(found)}"
    )
    plot(found, RESULTS / "curves.png")
    print(table(found))


if __name__ == "__main__":
    main()
