"""Store and report the paper's baselines, each trained for 100,000 frames with `+experiment=fast`.

    pgdm-run -m +experiment=fast task=TASKS method=deepmimic,graff total_frames=100_000
    pgdm-run -m +experiment=fast task=TASKS method=curriculum total_frames=100_000 \
        method.curriculum.ramp_frames=8000
    python benchmark/fast_methods.py runs/sweeps       store the runs finished by now, and report

TASKS is every third task of the suite tcdm30: `python benchmark/fast_methods.py --tasks` prints
them. PGDM itself is not trained again: its values are those that its runs in
`benchmark/results/tcdm50` had after 100,352 frames. The curriculum's ramp is as large a share of
the run as the paper's 4M frames are of its 50M.
"""

from __future__ import annotations

import argparse
from math import nan
from pathlib import Path
from typing import Any

import tcdm50
from scipy.stats import ttest_1samp
from short_runs import report, store
from study import ramp

from pgdm.config.compose import compose
from pgdm.config.identity import identity_hash
from pgdm.config.saved import load_config
from pgdm.config.schema import ExperimentCfg
from pgdm.config.suites import suite
from pgdm.runs.files import LOG, RESULT, read_json
from pgdm.runs.folder import find_runs
from pgdm.runs.log import RunLog

RESULTS = Path(__file__).parent / "results" / "fast_methods"
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "fast_methods.png"
TASKS = suite("tcdm30")[::3]
FRAMES = 100_000
BASELINES: dict[str, tuple[str, ...]] = {
    "deepmimic": ("method=deepmimic",),
    "graff": ("method=graff",),
    "curriculum": ("method=curriculum", ramp(FRAMES)),
}
SUCCESS, LIFTED = tcdm50.SUCCESS, tcdm50.LIFTED

Rows = dict[str, dict[str, tuple[float, float]]]
"""Success and share of lifted steps by task and method."""


def place(method: str, task: str) -> Path:
    """Return the folder of a stored run."""
    return RESULTS / "runs" / method / task


def settings(method: str, task: str) -> ExperimentCfg:
    """Return the settings of a baseline's run."""
    words = ["+experiment=fast", f"task={task}", f"total_frames={FRAMES}"]
    return compose([*words, "seed=0", *BASELINES[method]])


def wanted(cfg: ExperimentCfg) -> bool:
    """Return whether a run is one of those that are compared."""
    method, task = cfg.method.name, cfg.task.id
    if method not in BASELINES or task not in TASKS or cfg.total_frames != FRAMES:
        return False
    return identity_hash(cfg) == identity_hash(settings(method, task))


def of_pgdm(task: str) -> tuple[float, float] | None:
    """Return what PGDM had at the frames at which a baseline ends; None if it was not run."""
    folder = tcdm50.place(task, 0)
    if not (folder / RESULT).is_file() or not tcdm50.current(load_config(folder)):
        return None
    for line in RunLog(folder / LOG).read():
        if line["kind"] == "eval" and int(line["frames"]) >= FRAMES:
            return float(line[SUCCESS]), float(line[LIFTED])
    return None


def measured() -> Rows:
    """Return what has been measured by now."""
    found: Rows = {task: {} for task in TASKS}
    for task, methods in found.items():
        if (own := of_pgdm(task)) is not None:
            methods["pgdm"] = own
        for method in BASELINES:
            if (file := place(method, task) / RESULT).is_file():
                metrics: dict[str, Any] = read_json(file)["metrics"]
                methods[method] = metrics[SUCCESS], metrics[LIFTED]
    return found


def differences(rows: Rows, method: str) -> list[float]:
    """Return a baseline's success minus PGDM's for each task that has both."""
    both = [row for row in rows.values() if "pgdm" in row and method in row]
    return [row[method][0] - row["pgdm"][0] for row in both]


def table(rows: Rows) -> str:
    """Return a Markdown table of success and lifted, its last row the mean difference to PGDM."""
    names = ("pgdm", *BASELINES)
    lines = [f"| task | {' | '.join(names)} |", "|---" + "|--:" * len(names) + "|"]
    for task, row in rows.items():
        texts = ["" if m not in row else f"{row[m][0]:.1%} / {row[m][1]:.0%}" for m in names]
        lines.append(f"| {task} | {' | '.join(texts)} |")
    texts = [_interval(differences(rows, method)) for method in BASELINES]
    lines.append(f"| *minus pgdm, mean over tasks* | | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def _interval(values: list[float]) -> str:
    """Return the mean and its 95% interval by Student's t, in points."""
    if len(values) < 2:
        return ""
    low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
    return f"{100 * sum(values) / len(values):+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"


def draw(rows: Rows, file: Path) -> None:
    """Draw each task's success with each method, side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots()
    names = ("pgdm", *BASELINES)
    for number, method in enumerate(names):
        values = [row.get(method, (nan, nan))[0] for row in rows.values()]
        at = [task + 0.2 * (number - 1.5) for task in range(len(rows))]
        axes.bar(at, values, 0.19, label=method)
    axes.set_xticks(range(len(rows)), list(rows), rotation=25, ha="right", fontsize=8)
    axes.set(ylim=(0, 1), ylabel="success, sampled actions")
    axes.yaxis.set_major_formatter("{x:.0%}")
    figure.legend(loc="outside upper center", ncols=len(names), fontsize=8, frameon=False)
    figure.savefig(file, dpi=100)


def main() -> None:
    """Store the finished runs, then report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, help="with runs, at any depth")
    parser.add_argument("--tasks", action="store_true", help="print the tasks, and do no more")
    options = parser.parse_args()
    if options.tasks:
        print(",".join(TASKS))
        return
    for folder in options.folders:
        for found in find_runs(folder):
            if found.status() == "finished" and wanted(cfg := load_config(found.path)):
                store(found, place(cfg.method.name, cfg.task.id), RESULTS)
    rows = measured()
    stored = sum(len(row.keys() & BASELINES.keys()) for row in rows.values())
    title = f"{stored} of {len(TASKS) * len(BASELINES)} runs are stored"
    print(title)
    if stored:
        (RESULTS / "README.md").write_text(
            f"# {title}\n\n`+experiment=fast total_frames={FRAMES}`, one seed, actions sampled; "
            "success / lifted. The last row is the difference in success, in points, with its 95% "
            f"interval over the tasks. Page, curves and tables are in `report`.\n\n{table(rows)}"
        )
        draw(rows, PICTURE)
        raise SystemExit(report(RESULTS))


if __name__ == "__main__":
    main()
