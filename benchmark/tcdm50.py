"""Store and report runs of all 50 tasks of the benchmark with the recommended settings.

    pgdm-run -m +experiment=fast task=tcdm50 seed=0 sweep.name=tcdm50      train (10 to 20 hours)
    python benchmark/tcdm50.py runs/sweeps/tcdm50      store the runs finished by now, and report

Results can be stored while the sweep is running. The folders may contain other runs: only finished
runs of `+experiment=fast` are stored.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import mean
from typing import Any

from short_runs import report, store

from pgdm.config.compose import compose
from pgdm.config.identity import identity_hash
from pgdm.config.saved import load_config
from pgdm.config.schema import ExperimentCfg
from pgdm.config.suites import suite
from pgdm.report.results import paper
from pgdm.runs.files import RESULT, read_json
from pgdm.runs.folder import RunFolder, find_runs
from pgdm.runs.result import WRIST_BOUND

RESULTS = Path(__file__).parent / "results" / "tcdm50"
TASKS = suite("tcdm50")


def place(task: str, seed: int) -> Path:
    """Return the folder of a stored run."""
    return RESULTS / "runs" / f"{task}-s{seed}"


def fast(cfg: ExperimentCfg) -> ExperimentCfg:
    """Return today's recommended settings for a run's task and seed."""
    return compose(["+experiment=fast", f"task={cfg.task.id}", f"seed={cfg.seed}"])


def current(cfg: ExperimentCfg) -> bool:
    """Return whether a run has today's recommended settings."""
    return identity_hash(cfg) == identity_hash(fast(cfg))


def wanted(found: RunFolder) -> bool:
    """Return whether a finished run has today's settings and is to be stored.

    A stored run with earlier settings is replaced, one with today's only by a longer one.
    """
    task = found.config.get("task", {}).get("id")
    if found.status() != "finished" or task not in TASKS:
        return False
    cfg = load_config(found.path)
    if not current(cfg) or found.result["frames"] < fast(cfg).total_frames:
        return False
    before = place(task, cfg.seed)
    if not (before / RESULT).is_file() or not current(load_config(before)):
        return True
    return read_json(before / RESULT)["frames"] < found.result["frames"]


def nothing(task: str) -> float:
    """Return the success of an object that never moves from where the motion starts."""
    return float(paper()["null_policy"][task])


def table(rows: dict[Path, dict[str, Any]]) -> str:
    """Return stored results as a Markdown table, worst first."""
    lines = [
        "| task | seed | frames | minutes | success, sampled | deterministic | lifted "
        "| rigid grasp | doing nothing | paper | settings |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|---|",
    ]
    for folder, row in sorted(rows.items(), key=lambda r: r[1]["metrics"]["eval_sampled/success"]):
        cfg, metrics = load_config(folder), row["metrics"]
        cells = [
            metrics.get(f"eval_{kind}") for kind in ("sampled/success", "deterministic/success")
        ]
        cells += [metrics.get("eval_sampled/lifted"), row.get(WRIST_BOUND), nothing(cfg.task.id)]
        cells.append(cfg.task.paper_success)
        shown = " | ".join("-" if value is None else f"{value:.1%}" for value in cells)
        lines.append(
            f"| {cfg.task.id} | {cfg.seed} | {row['frames']:,} | {row['wall_time_s'] / 60:.0f} "
            f"| {shown} | {'' if current(cfg) else 'earlier'} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Store the finished runs, then report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, help="with runs, at any depth")
    for folder in parser.parse_args().folders:
        for found in find_runs(folder):
            if wanted(found):
                target = place(found.config["task"]["id"], int(found.config["seed"]))
                store(found, target, RESULTS)
                print(f"stored {target.name}", flush=True)
    files = sorted((RESULTS / "runs").glob(f"*/{RESULT}"))
    rows = {file.parent: read_json(file) for file in files}
    tasks: dict[str, list[float]] = {}
    for folder, row in rows.items():
        success = row["metrics"]["eval_sampled/success"]
        tasks.setdefault(load_config(folder).task.id, []).append(success)
    title = f"{len(tasks)} of {len(TASKS)} tasks, {len(rows)} runs"
    if rows:
        title += f", sampled success {mean(map(mean, tasks.values())):.1%}, the mean over the tasks"
        (RESULTS / "README.md").write_text(
            f"# {title}\n\n`+experiment=fast`; not comparable with the paper (50,000,000 "
            "frames, 3 seeds). Rigid grasp: what a grasp that never slips would reach with the "
            "planned commands. "
            "Doing nothing: success if the object never moves. "
            "Settings: earlier, if `+experiment=fast` was changed since the run. "
            f"Page, curves and tables are in `report`.\n\n{table(rows)}"
        )
    print(title)
    if rows and (code := report(RESULTS)):
        raise SystemExit(code)


if __name__ == "__main__":
    main()
