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
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from pgdm.config.saved import load_config
from pgdm.config.suites import suite
from pgdm.tracking.run_folder import read_json
from pgdm.tracking.run_log import RunLog

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


def train(folder: Path, task: str, setting: str) -> int:
    """Train one run to its end, or go on with it; return the exit code."""
    name = f"{task}-{setting}"
    command = [str(Path(sys.executable).with_name("pgdm-run")), f"task={task}", *COMMON]
    command += [*SETTINGS[setting], f"run_dir={folder / name}", "num_threads=1", "tracking=none"]
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{name}.log", "a") as log:
        return subprocess.run(command, stdout=log, stderr=log).returncode


def collect(run: Path, task: str, setting: str) -> dict[str, Any] | None:
    """Return what a finished run reached and how, or None if it has not finished."""
    result = read_json(run / "result.json")
    if result.get("status") != "finished":
        return None
    cfg = load_config(run)
    lines = RunLog(run / "metrics.jsonl").read()
    evals = [line for line in lines if line["kind"] == "eval"]
    curve = {
        f"{kind}/{name}": [
            round(float(line.get(f"{kind}/{name}", float("nan"))), 5) for line in evals
        ]
        for kind in ("eval_sampled", "eval_deterministic")
        for name in CURVES
    }
    return {
        "task": task,
        "setting": setting,
        "overrides": [*COMMON, *SETTINGS[setting]],
        "paper_success": cfg.task.paper_success,
        "paper_com_error": cfg.task.paper_com_error,
        "curve_frames": [line["frames"] for line in evals],
        "curves": curve,
        **{k: v for k, v in result.items() if k != "video"},
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
    jobs = [(task, setting) for setting in SETTINGS for task in QUICK6]
    if not options.collect:
        with ThreadPoolExecutor(2) as pool:
            codes = list(pool.map(lambda job: train(options.runs, *job), jobs))
        if any(codes):
            failed = [f"{t}-{s}" for (t, s), code in zip(jobs, codes, strict=True) if code]
            raise SystemExit(f"failed: {', '.join(failed)}; see the logs in {options.runs}")
    RESULTS.mkdir(parents=True, exist_ok=True)
    for task, setting in jobs:
        one = collect(options.runs / f"{task}-{setting}", task, setting)
        if one is not None:
            (RESULTS / f"{task}-{setting}.json").write_text(json.dumps(one, indent=1) + "\n")
    stored = [RESULTS / f"{task}-{setting}.json" for task, setting in jobs]
    found = [json.loads(file.read_text()) for file in stored if file.exists()]
    (RESULTS / "README.md").write_text(
        f"# {len(found)} of {len(jobs)} runs\n\n`python benchmark/learning.py`\n\n{table(found)}"
    )
    plot(found, RESULTS / "curves.png")
    print(table(found))


if __name__ == "__main__":
    main()
