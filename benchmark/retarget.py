"""Measure how well expert hand trajectories are rebuilt, leaving out each published one in turn.

    python benchmark/retarget.py [--tasks hammer-use1 cup-pour1]

Rebuilds every published trajectory of the benchmark from MyoHand's recording, by a regression
fitted without it, and compares the two. Also measures the last step alone, the limp hand that
follows the published human joints. Downloads both packages (190 MB, once). Without --tasks the
results are stored in results/retarget.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from pgdm import paths
from pgdm.library import open_library
from pgdm.library.experts import rebuild
from pgdm.library.experts.kinematics import ExpertHand
from pgdm.library.experts.rebuild import Rebuilder
from pgdm.library.files import npz as safe_npz
from pgdm.library.progress import ProgressLines
from pgdm.library.robohive import experts as wheel_experts
from pgdm.library.robohive import fill as registry
from pgdm.library.robohive import myohand, package_index
from pgdm.library.tasks import MOCAP_TASKS, REBUILT_EXPERTS

RESULT = Path(__file__).parent / "results" / "retarget.json"

GROUPS = {
    "base_m": slice(0, 3),
    "base_rad": slice(3, 6),
    "wrist_rad": slice(6, 8),
    "ff_rad": slice(8, 12),
    "mf_rad": slice(12, 16),
    "rf_rad": slice(16, 20),
    "lf_rad": slice(20, 25),
    "th_rad": slice(25, 30),
    "fingers_rad": slice(8, 30),
}
"""Adroit's joints by group, compared by root mean square."""

COLUMNS = {
    "human_mm": "human joints, mm",
    "fingertips_mm": "fingertips, mm",
    **{group: group.replace("_", " ") for group in GROUPS},
    "limp_fingertips_mm": "limp hand alone: fingertips, mm",
    "limp_fingers_rad": "fingers rad",
}


@dataclass(frozen=True)
class Measure:
    """Compares rebuilt trajectories with the published ones."""

    rebuilder: Rebuilder
    hand: ExpertHand

    def __call__(self, task: str) -> dict[str, float]:
        """Return the metrics of one task."""
        path = self.rebuilder.published(task)
        known = wheel_experts.read(path, task, open_library().motion(task))
        qpos = self.hand.shifted(known.qpos, known.shift)
        made = self.rebuilder.rebuild(task)
        away = made.human_joints - (known.human_joints + known.shift)
        found = {
            "human_mm": 1e3 * float(np.linalg.norm(away, axis=-1).mean()),
            "fingertips_mm": self.fingertips_mm(made.qpos, qpos),
        }
        for group, joints in GROUPS.items():
            found[group] = float(np.sqrt(((made.qpos - qpos)[:, joints] ** 2).mean()))
        arrays = safe_npz.read_npz(path)
        limp = self.rebuilder.track(
            task,
            arrays["human_joint_coords"],
            arrays["object_translation"],
            arrays["object_orientation"],
        )[known.skipped : known.skipped + len(qpos)]
        fingers = (limp - known.qpos)[:, GROUPS["fingers_rad"]]
        found["limp_fingertips_mm"] = self.fingertips_mm(limp, known.qpos)
        found["limp_fingers_rad"] = float(np.sqrt((fingers**2).mean()))
        return found

    def fingertips_mm(self, joints: np.ndarray, others: np.ndarray) -> float:
        """Return the mean fingertip distance with joints clipped to their ranges, mm."""
        tips = [self.hand.fingertips(self.hand.clipped(q)) for q in (joints, others)]
        return 1e3 * float(np.linalg.norm(tips[0] - tips[1], axis=-1).mean())


def show(console: Console, found: dict[str, dict[str, float]]) -> None:
    """Print a table with one row per task, mean and median last."""
    table = Table("task", *COLUMNS.values())
    rows = [*found.items(), *summary(found).items()]
    for name, row in rows:
        table.add_row(name, *(f"{row[column]:.3g}" for column in COLUMNS))
    console.print(table)


def summary(found: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return mean and median over tasks."""
    values = {column: [row[column] for row in found.values()] for column in COLUMNS}
    return {
        "mean": {column: float(np.mean(v)) for column, v in values.items()},
        "median": {column: float(np.median(v)) for column, v in values.items()},
    }


def rounded(rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return values with four decimals."""
    return {name: {key: round(v, 4) for key, v in row.items()} for name, row in rows.items()}


def main() -> None:
    """Measure and print; store the results unless --tasks was given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", help="measure only these and store nothing")
    chosen = parser.parse_args().tasks
    known = [task for task in MOCAP_TASKS if task not in REBUILT_EXPERTS]
    if unknown := set(chosen or ()) - set(known):
        parser.error(f"no published trajectory of {', '.join(sorted(unknown))}")
    console, begun = Console(width=200), time.monotonic()
    say = ProgressLines(print)
    archives = [
        package_index.fetch(package, paths.downloads(), False, say)
        for package in (registry.PACKAGE, myohand.PACKAGE)
    ]
    found: dict[str, dict[str, float]] = {}
    library = open_library()
    with rebuild.unpacked(archives[0], archives[1], say) as folder:
        rebuilder = Rebuilder(library, folder, say)
        measure = Measure(rebuilder, ExpertHand(library.hand_xml("adroit")))
        for i, task in enumerate(chosen or known):
            say("tasks", i, len(chosen or known))
            found[task] = measure(task)
    show(console, found)
    if chosen:
        return
    stored = {
        "command": "python benchmark/retarget.py",
        "recordings_to_learn_from": len(rebuilder.tasks()) - 1,
        "seconds": round(time.monotonic() - begun, 1),
        "cores": len(os.sched_getaffinity(0)),
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        **rounded(summary(found)),
        "tasks": rounded(found),
    }
    RESULT.write_text(json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    main()
