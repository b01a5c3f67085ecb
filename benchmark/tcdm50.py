"""Store and report runs of all 50 tasks of the benchmark with the recommended settings.

    pgdm-run -m +experiment=fast task=tcdm50 seed=0 sweep.name=tcdm50      train (10 to 20 hours)
    python benchmark/tcdm50.py runs/sweeps/tcdm50      store the runs finished by now, and report

Results can be stored while the sweep is running. The folders may contain other runs: only finished
runs of `+experiment=fast` are stored.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from math import isnan, nan
from pathlib import Path
from statistics import mean
from typing import Any

from short_runs import report, store

from pgdm.config.compose import compose
from pgdm.config.identity import difference, identity_hash
from pgdm.config.saved import load_config
from pgdm.config.schema import ExperimentCfg
from pgdm.config.suites import suite
from pgdm.report.results import paper
from pgdm.runs.files import RESULT, read_json
from pgdm.runs.folder import RunFolder, find_runs
from pgdm.runs.result import WRIST_BOUND

RESULTS = Path(__file__).parent / "results" / "tcdm50"
PAGE = Path(__file__).parent.parent / "docs" / "tcdm50.md"
PICTURE = PAGE.parent / "images" / "tcdm50.png"
TASKS = suite("tcdm50")
EARLIER = "earlier"
SUCCESS, LIFTED = "eval_sampled/success", "eval_sampled/lifted"


def place(task: str, seed: int) -> Path:
    """Return the folder of a stored run."""
    return RESULTS / "runs" / f"{task}-s{seed}"


def fast(cfg: ExperimentCfg) -> ExperimentCfg:
    """Return today's recommended settings for a run's task and seed."""
    return compose(["+experiment=fast", f"task={cfg.task.id}", f"seed={cfg.seed}"])


def current(cfg: ExperimentCfg) -> bool:
    """Return whether a run has today's recommended settings."""
    return identity_hash(cfg) == identity_hash(fast(cfg))


def whole_error(cfg: ExperimentCfg) -> bool:
    """Return whether a run differs from today's settings only by ``shaping.beyond_plan=false``."""
    return difference(cfg, fast(cfg)) == ["shaping.beyond_plan: False -> True"]


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


def papers(task: str) -> float:
    """Return the paper's success."""
    value = compose([f"task={task}"]).task.paper_success
    return nan if value is None else value


def table(rows: dict[Path, dict[str, Any]]) -> str:
    """Return stored results as a Markdown table, worst first."""
    lines = [
        "| task | seed | frames | minutes | success, sampled | deterministic | lifted "
        "| rigid grasp | doing nothing | paper | settings |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|---|",
    ]
    for folder, row in sorted(rows.items(), key=lambda r: r[1]["metrics"][SUCCESS]):
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


def by_task(rows: dict[Path, dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the results of each task, best task first.

    If a task has none with today's settings, those of `whole_error` are returned.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    loaded = [(load_config(folder), row) for folder, row in rows.items()]
    for accepts in (current, whole_error):
        complete = set(found)
        for cfg, row in loaded:
            if cfg.task.id not in complete and accepts(cfg):
                found.setdefault(cfg.task.id, []).append(row | {EARLIER: accepts is not current})
    return dict(sorted(found.items(), key=lambda item: -mean_of(item[1], SUCCESS)))


def mean_of(rows: Iterable[dict[str, Any]], metric: str) -> float:
    """Return the mean of a metric over results, NaN if none has it (a door has no ``lifted``)."""
    values = [row["metrics"][metric] for row in rows if metric in row["metrics"]]
    return mean(values) if values else nan


def task_table(tasks: dict[str, list[dict[str, Any]]]) -> str:
    """Return the results of `by_task` as a Markdown table, and their means by pre-grasp source."""
    lines = [
        "| task | success | each seed | lifted | rigid grasp | doing nothing | paper |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    groups: dict[str, list[tuple[float, ...]]] = {}
    for task, rows in tasks.items():
        cfg = compose([f"task={task}"]).task
        bound = rows[0].get(WRIST_BOUND, nan)
        cells = (mean_of(rows, SUCCESS), float(bound), nothing(task), papers(task))
        for group in ("all", cfg.pregrasp_source):
            groups.setdefault(group, []).append(cells)
        seeds = ", ".join(f"{row['metrics'][SUCCESS]:.1%}" for row in rows)
        name = f"{task} (1)" if rows[0][EARLIER] else task
        lines.append(_line(name, cells, seeds if len(rows) > 1 else "", mean_of(rows, LIFTED)))
    for group, of_tasks in groups.items():
        cells = tuple(mean(column) for column in zip(*of_tasks, strict=True))
        lines.append(_line(f"*mean, {group} ({len(of_tasks)})*", cells, "", nan))
    return "\n".join(lines) + "\n"


def _line(name: str, cells: tuple[float, ...], seeds: str, lifted: float) -> str:
    success, *others = (f"{value:.1%}" for value in cells)
    held = "-" if isnan(lifted) else f"{lifted:.0%}"
    return f"| {name} | {success} | {seeds} | {held} | {' | '.join(others)} |"


def draw(tasks: dict[str, list[dict[str, Any]]], file: Path) -> None:
    """Draw each task's success beside the paper's and that of doing nothing."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.2 + 0.2 * len(tasks)), layout="constrained")
    axes = figure.subplots()
    at = range(len(tasks))
    axes.barh(at, [mean_of(rows, SUCCESS) for rows in tasks.values()], color="#5fa8a0")
    for row, results in zip(at, tasks.values(), strict=True):
        seeds = [result["metrics"][SUCCESS] for result in results]
        axes.plot(seeds, [row] * len(seeds), "|", color="#1d5c55", label="each seed")
    axes.plot(
        [papers(task) for task in tasks],
        at,
        "D",
        color="#c2571a",
        markersize=4,
        label="paper, 50,000,000 frames",
    )
    axes.plot(
        [nothing(t) for t in tasks], at, "x", color="grey", markersize=4, label="doing nothing"
    )
    axes.set(xlim=(0, 1.01), ylim=(len(tasks) - 0.4, -0.6), xlabel="success, sampled actions")
    axes.set_yticks(at, tasks, fontsize=8)
    axes.xaxis.set_major_formatter("{x:.0%}")
    shown = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(shown.values(), shown, loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(file, dpi=100)


def stored() -> dict[Path, dict[str, Any]]:
    """Return the stored results by folder."""
    files = sorted((RESULTS / "runs").glob(f"*/{RESULT}"))
    return {file.parent: read_json(file) for file in files}


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
    rows = stored()
    tasks = by_task(rows)
    title = f"{len(tasks)} of {len(TASKS)} tasks, {sum(map(len, tasks.values()))} runs"
    if tasks:  # none while all stored runs have earlier settings
        average = mean(mean_of(of_task, SUCCESS) for of_task in tasks.values())
        title += f", sampled success {average:.1%}, the mean over the tasks"
    if rows:
        (RESULTS / "README.md").write_text(
            f"# {title}\n\n`+experiment=fast`; not comparable with the paper (50,000,000 frames, "
            "3 seeds). Those marked earlier were made before the settings changed; the title "
            "counts them for tasks without newer runs if only `shaping.beyond_plan` was false. "
            "Rigid grasp: what a grasp that never slips would reach with the planned commands. "
            "Doing nothing: success if the object never moves. Page, curves and tables are in "
            f"`report`.\n\n{table(rows)}"
        )
        page = PAGE.read_text()
        PAGE.write_text(re.sub(r"\| task \|.*?\n(?=\n)", task_table(tasks), page, flags=re.DOTALL))
        draw(tasks, PICTURE)
    print(title)
    if rows and (code := report(RESULTS)):
        raise SystemExit(code)


if __name__ == "__main__":
    main()
