"""Run the paper's comparisons at a hundredth of its length, on the suite quick6.

    python benchmark/study.py                             train what is missing (hours), then report
    python benchmark/study.py --settings graff-residual   only some of the settings
    python benchmark/study.py --collect                   report only

Trains the methods, the ablations and the start without a pre-grasp with one seed, 0.5M frames and
`algo=ppo_fast action=residual`; PGDM, the open hand, 15 cm and no pre-grasp also with the paper's
actions. Each setting is a sweep (`pgdm-run -m`): the same command resumes it. Runs are stored
without checkpoints and videos, their training curves thinned, and `pgdm report` makes page and
tables from them. A stored run is not trained again, not even on another machine.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from short_runs import program, report, store

from pgdm.config.suites import suite
from pgdm.runs.files import RESULT
from pgdm.runs.folder import find_runs

RESULTS = Path(__file__).parent / "results" / "study"
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "study.png"
FRAMES = 500_000


def ramp(frames: int) -> str:
    """Return the curriculum's ramp, as large a share of a run as the paper's 4M are of its 50M."""
    return f"method.curriculum.ramp_frames={4_000_000 * frames // 50_000_000}"


TASKS = suite("quick6")
EXPERTS = [task for task in TASKS if task in suite("adroit_experts")]
"""Tasks with a published expert hand trajectory: DeepMimic and GRAFF* need one."""

COMMON = (
    "algo=ppo_fast",
    "seed=0",
    f"total_frames={FRAMES}",
    "budget=reduced",
    "eval.interval_frames=100000",
    "eval.video=false",
)
_CHANGES = {
    "pgdm": (TASKS, ()),
    "no_pregrasp": (TASKS, ("pregrasp=none",)),
    "open_hand": (TASKS, ("ablation=open_hand",)),
    "mean_hand": (TASKS, ("ablation=mean_hand",)),
    "distance_15cm": (TASKS, ("ablation=distance_15cm",)),
    "distance_25cm": (TASKS, ("ablation=distance_25cm",)),
    "deepmimic": (EXPERTS, ("method=deepmimic",)),
    "graff": (EXPERTS, ("method=graff",)),
    "curriculum": (TASKS, ("method=curriculum", ramp(FRAMES))),
}
# Also with the paper's actions, since residual ones cannot move the hand back to its pre-grasp.
_ALSO_ABSOLUTE = ("pgdm", "no_pregrasp", "open_hand", "distance_15cm")
SETTINGS = {
    f"{name}-{action}": (_CHANGES[name][0], (f"action={action}", *_CHANGES[name][1]))
    for action, names in (("residual", _CHANGES), ("absolute", _ALSO_ABSOLUTE))
    for name in names
}
"""Tasks and overrides of each sweep; ``absolute`` are the paper's actions."""

Rows = dict[str, list[tuple[float, float | None] | str]]


def place(setting: str, task: str) -> Path:
    """Return the folder of a stored run."""
    return RESULTS / "runs" / setting / task


def run(setting: str, folder: Path) -> int:
    """Train the tasks of a setting that are not stored, and store the finished runs."""
    tasks, overrides = SETTINGS[setting]
    missing = [task for task in tasks if not (place(setting, task) / RESULT).exists()]
    if not missing:
        return 0
    command = [program("pgdm-run"), "-m", f"task={','.join(missing)}"]
    command += [*COMMON, *overrides, f"sweep.name={setting}", f"sweep.dir={folder / setting}"]
    code = subprocess.run(command).returncode
    for found in find_runs(folder / setting / "runs"):
        if found.status() == "finished":
            store(found, place(setting, found.config["task"]["id"]), RESULTS)
    return code


def measured() -> Rows:
    """Return success and lifted (None for a door) by setting and task, or why there are none."""
    found: Rows = {}
    for setting, (tasks, _) in SETTINGS.items():
        cells = found.setdefault(setting, [])
        for task in TASKS:
            file = place(setting, task) / RESULT
            if file.exists():
                metrics = json.loads(file.read_text())["metrics"]
                lifted = metrics.get("eval_sampled/lifted")
                cells.append((metrics["eval_sampled/success"], lifted))
            else:
                cells.append("not run" if task in tasks else "no expert")
    return found


def table(rows: Rows) -> str:
    """Return rows as a Markdown table."""
    lines = [f"| setting | {' | '.join(TASKS)} |", "|---" + "|--:" * len(TASKS) + "|"]
    for setting, cells in rows.items():
        texts = [
            c if isinstance(c, str) else f"{c[0]:.1%} / {'-' if c[1] is None else f'{c[1]:.0%}'}"
            for c in cells
        ]
        lines.append(f"| `{setting}` | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def draw(rows: Rows, file: Path) -> None:
    """Draw success and lifted side by side, higher values darker."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.4), layout="constrained")
    for number, title in enumerate(("success", "lifted")):
        axes = figure.add_subplot(1, 2, number + 1)
        values = np.full((len(rows), len(TASKS)), np.nan)
        for row, cells in enumerate(rows.values()):
            for column, cell in enumerate(cells):
                value = None if isinstance(cell, str) else cell[number]
                values[row, column] = np.nan if value is None else value
                missing = cell if isinstance(cell, str) else "-"
                text = missing if value is None else f"{value:.{1 - number}%}"
                axes.text(column, row, text, ha="center", va="center", fontsize=8)
        axes.imshow(values, cmap="GnBu", vmin=0.0, vmax=(0.6, 1.3)[number], aspect="auto")
        axes.set_title(title, fontsize=10)
        axes.set_xticks(range(len(TASKS)), TASKS, rotation=20, ha="right", fontsize=8)
        names = list(rows) if not number else [""] * len(rows)
        axes.set_yticks(range(len(rows)), names, fontsize=9)
        axes.tick_params(length=0)
    figure.savefig(file, dpi=100)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, store, report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/study"))
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--collect", action="store_true", help="train nothing")
    options = parser.parse_args(arguments)
    codes = [] if options.collect else [run(s, options.runs) for s in options.settings]
    stored = len(list((RESULTS / "runs").glob(f"*/*/{RESULT}")))
    title = f"{stored} of {sum(len(tasks) for tasks, _ in SETTINGS.values())} runs are stored"
    print(title)
    if stored:
        rows = measured()
        (RESULTS / "README.md").write_text(
            f"# {title}\n\n`python benchmark/study.py`: one seed, {FRAMES:,} frames (the paper: "
            "50,000,000), actions sampled; success / lifted. Page, pictures and tables are in "
            f"`report`.\n\n{table(rows)}"
        )
        draw(rows, PICTURE)
        codes.append(report(RESULTS))
    if any(codes):
        raise SystemExit(
            f"a run or the report failed (exit codes {codes}); the same command resumes"
        )


if __name__ == "__main__":
    main()
