"""Measure how far ablated starts deviate from the ablations' definitions, over all tasks.

    python benchmark/ablations.py [--csv FILE] [TASK ...]

Fetches missing assets if possible; the other tasks need a checkout. ``pregrasp=planned`` falls back
to mined if no plan is stored. Prints a summary in Markdown, as in docs/ablations.md, and writes a
CSV row for every start. The column ``residual_gap_m`` is the fingertips' mean distance from their
positions in the pre-grasp (for ``pregrasp=none``: in the planned start) after the best correction
of the base that ``action=residual`` allows.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import statistics
import time
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.minimize import least_squares

from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.experiment import assets, env_builder
from pgdm.pregrasp.ablation.ablate import ablate
from pgdm.pregrasp.sources import StartState, start_state
from pgdm.sim.scene import Scene

STARTS = ("planned", "mined", "none")  # the last start, the reset pose, has nothing to ablate
SCALE = compose(["action=residual"]).action.residual_scale
RESULTS = Path(__file__).parent / "results" / "ablations.csv"


def measure(task: str) -> list[dict[str, Any]]:
    """Return a row for each start state and ablation of a task."""
    rows = []
    whole = compose([f"task={task}"])
    builder = env_builder(whole, assets(whole, print))
    goals: dict[str, StartState] = {}
    for pregrasp in STARTS:
        for ablation in available("ablation") if pregrasp != "none" else ("none",):
            # Composed without the task, which does not matter here: once for each choice.
            cfg = compose([f"pregrasp={pregrasp}", f"ablation={ablation}"])
            stored = start_state(cfg.pregrasp, builder.motion, builder.scene)
            began = time.process_time()
            found = ablate(cfg.ablation, stored, builder.scene, builder.motion.substeps)
            seconds = time.process_time() - began
            values = {k: v for k, v in dataclasses.asdict(found).items() if k != "start"}
            goals.setdefault(pregrasp, stored)
            goal = goals["planned" if pregrasp == "none" else pregrasp]
            gap = residual_gap(builder.scene, goal.qpos, found.start.qpos)
            row = {"pregrasp": pregrasp, "ablation": ablation, "task": task, **values}
            row["residual_gap_m"] = gap
            rows.append(row | {"seconds": seconds})
    return rows


def residual_gap(scene: Scene, stored: np.ndarray, ablated: np.ndarray) -> float:
    """Return the fingertips' mean distance from their positions after the best correction, m."""
    model, index = scene.model, scene.index
    data, base = mujoco.MjData(model), index.num_base_joints
    tips = index.point_geoms[index.fingertips]

    def places(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        return data.geom_xpos[tips].copy()

    goal = places(stored)

    def off(corrections: np.ndarray) -> np.ndarray:  # (base, k) -> (3F, k)
        found = []
        for correction in corrections.T:
            qpos = ablated.copy()
            qpos[:base] += correction
            found.append((places(qpos) - goal).ravel())
        return np.stack(found, axis=1)

    reach = SCALE * 0.5 * (index.ctrl_high - index.ctrl_low)[:base]
    best, _ = least_squares(np.zeros(base), off, bounds=[-reach, reach], verbose=0)
    return float(np.linalg.norm(off(best[:, None]).reshape(-1, 3), axis=1).mean())


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return the summary as a table in Markdown: largest values over the tasks."""
    names = (
        *("start", "ablation", "tasks", "simulated", "retreated", "retreat [mm]"),
        *(
            "distance [cm]",
            "finger error [rad]",
            "object pushed [mm]",
            "penetration [mm]",
            "time [s]",
            "residual gap [cm]",
        ),
    )
    table = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    key = itemgetter("pregrasp", "ablation")
    for (pregrasp, ablation), group in groupby(sorted(rows, key=key), key):
        some = list(group)

        def most(name: str, some: list[dict[str, Any]] = some) -> float:
            return max(row[name] for row in some)

        least = min(row["distance_m"] for row in some)
        cells = (
            *(f"`{pregrasp}`", f"`{ablation}`", len(some), sum(row["simulated"] for row in some)),
            *(sum(row["retreat_m"] > 0 for row in some), f"{1e3 * most('retreat_m'):.0f}"),
            f"{1e2 * least:.1f}-{1e2 * most('distance_m'):.1f}",
            *(f"{most('finger_error_rad'):.2f}", f"{1e3 * most('object_moved_m'):.1f}"),
            *(f"{1e3 * most('depth_m'):.1f}", f"{most('seconds'):.2f}"),
            f"{1e2 * statistics.median(row['residual_gap_m'] for row in some):.1f}",
        )
        table.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return table


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", default=available("task"), metavar="TASK")
    parser.add_argument("--csv", type=Path, default=RESULTS, help=f"[{RESULTS}]")
    arguments = parser.parse_args()
    rows = [row for task in arguments.tasks for row in measure(task)]
    with arguments.csv.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=rows[0])
        writer.writeheader()
        for row in rows:
            exact = {k: f"{v:.6f}" if isinstance(v, float) else v for k, v in row.items()}
            writer.writerow(exact)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
