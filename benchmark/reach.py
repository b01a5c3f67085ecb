"""Compare pgdm's reach plans with the released ones, and measure the quality of every pre-grasp.

    python benchmark/reach.py [--seed 0 1 2] [TASK ...]
    python benchmark/reach.py --write

The first command plans the reach to the mined pre-grasp of each task, plays the plan stored with
the task for comparison, and measures every pre-grasp of the task. Results are stored in
results/reach/, one file per task; a stored result is not computed again. The second command writes
the summary, the picture and the tables of docs/pregrasps/ from these results. Needs a library with
the tasks' assets and experts; released plans come with a TCDM checkout only. Predicted hands are
those of benchmark/predictor.py, and demonstrations those that PGDM_DAPG_DEMOS names.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import paths
from pgdm.config.compose import compose
from pgdm.config.suites import suite
from pgdm.library import Library, Motion, open_library
from pgdm.pregrasp.ablation.ablate import ablate
from pgdm.pregrasp.quality import LiftTest, quality
from pgdm.pregrasp.reach.plan import measure
from pgdm.pregrasp.reach.planner import REACH, plan_reach
from pgdm.pregrasp.reach.stored import pose_of, published
from pgdm.pregrasp.retarget.mocap import of_expert, retarget
from pgdm.pregrasp.sources import StartState, object_joints, start_state
from pgdm.pregrasp.teleop import cut as teleop
from pgdm.pregrasp.teleop import demonstrations
from pgdm.sim.scene import Scene, build_scene

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "reach"
PREDICTED = HERE / "results" / "predictor"
DOCS = HERE.parent / "docs"
Row = dict[str, Any]


def main() -> None:
    """Measure what is missing, or write the pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    parser.add_argument("--seed", type=int, nargs="+", default=[0], help="seeds of the search [0]")
    parser.add_argument("--write", action="store_true", help="write summary, picture and pages")
    arguments = parser.parse_args()
    if arguments.write:
        write_pages(read_rows())
        return
    for seed in arguments.seed:
        for task in arguments.tasks or suite("tcdm50"):
            update(task, seed)


def update(task: str, seed: int) -> None:
    """Measure a task with a seed, unless it is stored, and store it."""
    path = RESULTS / f"{task}.json"
    row: Row = json.loads(path.read_text()) if path.is_file() else {"task": task, "ours": {}}
    if row.get("search") != repr(REACH):
        row = {"task": task, "search": repr(REACH), "ours": {}}
    if str(seed) in row["ours"]:
        return
    cfg = compose([f"task={task}"])
    library = open_library()
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    motion = library.motion(cfg.task.motion)
    target = pose_of("mined", motion, scene)
    began = time.process_time()
    plan = plan_reach(scene, target, motion.substeps, seed=seed)
    cpu_s = time.process_time() - began
    row["ours"][str(seed)] = {
        **plan.metrics(),
        "seconds": round(plan.seconds, 1),
        "cpu_s": cpu_s,
        "failures": plan.failures,
    }
    if (stored := published(motion, scene)) is not None and stored.actions is not None:
        theirs = measure(scene, stored.actions, target, motion.substeps)
        row["released"] = {**theirs.metrics(), "failures": theirs.failures}
    known = row.setdefault("quality", {})
    starts = {**all_starts(scene, library, motion), "reach": plan.state.qpos}
    lift = LiftTest(scene, motion.substeps)
    for name in sorted(starts.keys() - known.keys()):
        known[name] = dataclasses.asdict(quality(scene, starts[name], motion.substeps, lift))
    RESULTS.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        temp.write_text(json.dumps(row, indent=1))
    state = "reached" if plan.reached else "; ".join(plan.failures)
    print(
        f"{task:24} seed {seed}  {state}  {plan.seconds:.0f} s ({cpu_s:.0f} s of CPU)", flush=True
    )


def all_starts(scene: Scene, library: Library, motion: Motion) -> dict[str, np.ndarray]:
    """Return the task's starts of every source, and the mined start with ablated fingers."""
    starts = {name: start.qpos for name, start in motion.starts.items()}
    if motion.id in library.experts().experts:
        human = of_expert(library.expert(motion.id), motion)
        starts["mocap"] = retarget(scene, library, motion, human).result.qpos
    predicted = PREDICTED / f"{scene.task.id}.json"
    if predicted.is_file():
        starts["predicted"] = np.array(json.loads(predicted.read_text())["learned_chosen_qpos"])
    demonstrations_file = os.environ.get("PGDM_DAPG_DEMOS")
    if scene.task.id in teleop.LAYOUTS and demonstrations_file:
        replays = [teleop.replay(scene, d) for d in demonstrations.read(Path(demonstrations_file))]
        objects = object_joints(motion, scene)
        cut = teleop.cut(scene, teleop.nearest(replays), objects, "demonstrations")
        starts["teleop"] = cut.pose.qpos
    mined: StartState = start_state(compose(["pregrasp=mined"]).pregrasp, motion, scene)
    for name in ("open_hand", "mean_hand"):
        cfg = compose([f"ablation={name}"]).ablation
        starts[name] = ablate(cfg, mined, scene, motion.substeps).start.qpos
    return starts


def read_rows() -> list[Row]:
    """Return the stored results, in the order of the suite."""
    found = {path.stem: json.loads(path.read_text()) for path in RESULTS.glob("*.json")}
    return [found[task] for task in suite("tcdm50") if task in found]


COLUMNS: dict[str, tuple[str, float, float, str]] = {
    "base_error_m": ("base, slides [mm]", 1e3, 10.0, ".1f"),
    "base_error_rad": ("base, hinges [rad]", 1.0, 0.1, ".3f"),
    "finger_error_rad": ("fingers [rad]", 1.0, 0.1, ".3f"),
    "object_moved_m": ("object moved [mm]", 1e3, 5.0, ".1f"),
    "depth_m": ("penetration [mm]", 1e3, 1.0, ".1f"),
}
"""Metrics of a plan: heading, factor to its unit, tolerance in that unit, format."""

SOURCES = {
    "mined": "`mined`",
    "planned": "`planned`: after the released plan",
    "reach": "after our plan",
    "mocap": "`mocap`: ours, from the recorded human hand",
    "teleop": "`teleop`: ours, from demonstrations",
    "predicted": "`learned`: ours, the object held out, best of 4",
    "learned": "`learned`: as released",
    "open_hand": "`mined`, `ablation=open_hand`",
    "mean_hand": "`mined`, `ablation=mean_hand`",
}
HEADS = {"reach": "our plan", "predicted": "learned, ours", "learned": "learned, released"}


def write_pages(rows: list[Row]) -> None:
    """Write summary and picture of the reach, and the tables of the pages."""
    (RESULTS / "summary.md").write_text("\n".join([*summary(rows), "", *per_task(rows)]) + "\n")
    draw(rows, DOCS / "images" / "reach-errors.png")
    replace_between(DOCS / "pregrasps" / "reach.md", "summary", summary(rows))
    replace_between(DOCS / "pregrasps" / "reach.md", "tasks", per_task(rows))
    replace_between(DOCS / "pregrasps" / "quality.md", "sources", quality_summary(rows))
    replace_between(DOCS / "pregrasps" / "quality.md", "tasks", quality_per_task(rows))


def replace_between(page: Path, name: str, lines: list[str]) -> None:
    """Replace what a page has between ``<!-- name -->`` and ``<!-- /name -->``."""
    before, found, rest = page.read_text().partition(f"<!-- {name} -->\n")
    _, ended, after = rest.partition(f"<!-- /{name} -->")
    if not found or not ended:
        raise SystemExit(f"error: {page} has no <!-- {name} --> ... <!-- /{name} -->")
    page.write_text(f"{before}{found}\n" + "\n".join(lines) + f"\n\n{ended}{after}")


def summary(rows: list[Row]) -> list[str]:
    """Return the distribution of errors: ours over all seeds, and the released plans'."""
    ours = [one for row in rows for one in row["ours"].values()]
    theirs = [row["released"] for row in rows if "released" in row]
    seeds = max(len(row["ours"]) for row in rows)
    heads = ["plans", "number", "reached", *(head for head, *_ in COLUMNS.values()), "time [s]"]
    lines = table_head(heads)
    for name, some in ((f"ours, {seeds} seed{'s' * (seeds > 1)}", ours), ("released", theirs)):
        cells = [name, str(len(some)), str(sum(one["reached"] for one in some))]
        for key, (_, factor, _, form) in COLUMNS.items():
            cells.append(spread([factor * one[key] for one in some], form))
        cells.append(spread([one["seconds"] for one in some if "cpu_s" in one], ".0f"))
        lines.append(row_of(cells))
    return lines


def spread(values: list[float], form: str) -> str:
    """Return median and largest value."""
    if not values:
        return "-"
    return f"{statistics.median(values):{form}} / {max(values):{form}}"


def per_task(rows: list[Row]) -> list[str]:
    """Return the metrics of each task: ours of the first seed, then the released plan's."""
    heads = [
        "task",
        *(head for head, *_ in COLUMNS.values()),
        "target beyond limits",
        "rounds",
        "s",
    ]
    lines = table_head(heads)
    for row in rows:
        ours, theirs = next(iter(row["ours"].values())), row.get("released")
        cells = [row["task"]]
        for key, (_, factor, most, form) in COLUMNS.items():
            limit = max(most, factor * ours["target_depth_m"]) if key == "depth_m" else most
            both = [factor * one[key] for one in (ours, theirs) if one is not None]
            cells.append(" / ".join(bold_above(value, limit, form) for value in both))
        beyond = f"{1e3 * ours['beyond_m']:.0f} mm, {ours['beyond_rad']:.2f} rad"
        lines.append(row_of([*cells, beyond, str(ours["rounds"]), f"{ours['seconds']:.0f}"]))
    return lines


def bold_above(value: float, limit: float, form: str) -> str:
    """Return a number, bold if it exceeds its tolerance."""
    return f"**{value:{form}}**" if value > limit else f"{value:{form}}"


def quality_summary(rows: list[Row]) -> list[str]:
    """Return the metrics of each source over its tasks."""
    heads = ["source", "tasks", "free of contact", "penetration [mm]", "fingertips [mm]"]
    lines = table_head([*heads, "palm [deg]", "lift", "tasks lifted"])
    for name, title in SOURCES.items():
        some = [row["quality"][name] for row in rows if name in row["quality"]]
        if not some:
            continue
        lifts = [one["lift_rate"] for one in some if not math.isnan(one["lift_rate"])]
        deepest = max(1e3 * one["depth_m"] for one in some)
        cells = [title, str(len(some)), str(sum(one["free"] for one in some)), f"{deepest:.1f}"]
        cells.append(f"{1e3 * mean(one['fingertip_distance_m'] for one in some):.0f}")
        cells.append(f"{mean(math.degrees(one['palm_angle_rad']) for one in some):.0f}")
        cells += [f"{mean(iter(lifts)):.0%}" if lifts else "no lift"]
        cells += [f"{sum(lift > 0 for lift in lifts)} of {len(lifts)}"]
        lines.append(row_of(cells))
    return lines


def quality_per_task(rows: list[Row]) -> list[str]:
    """Return lift rate, penetration, distance and palm angle of each task and source."""
    names = [name for name in SOURCES if any(name in row["quality"] for row in rows)]
    lines = table_head(["task", *(HEADS.get(name, name.replace("_", " ")) for name in names)])
    for row in rows:
        lines.append(row_of([row["task"], *(cell(row["quality"].get(name)) for name in names)]))
    return lines


def cell(one: Row | None) -> str:
    """Return the quality of a pre-grasp in a few characters."""
    if one is None:
        return "-"
    lift = "no lift" if math.isnan(one["lift_rate"]) else f"**{one['lift_rate']:.0%}**"
    touch = "" if one["free"] else f", {1e3 * one['depth_m']:.1f} mm deep"
    angle = math.degrees(one["palm_angle_rad"])
    return f"{lift} {1e3 * one['fingertip_distance_m']:.0f} mm {angle:.0f}°{touch}"


def mean(values: Iterator[float]) -> float:
    """Return the mean."""
    return statistics.fmean(values)


def table_head(heads: list[str]) -> list[str]:
    """Return the first two lines of a table in Markdown."""
    return [row_of(heads), "|---" * len(heads) + "|"]


def row_of(cells: list[str]) -> str:
    """Return a line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def draw(rows: list[Row], path: Path) -> None:
    """Draw histograms of the errors, as shares of the plans."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.2), layout="constrained")
    keys = [key for key in COLUMNS if key != "depth_m"]
    pick: dict[str, Callable[[Row], list[Row]]] = {
        "ours": lambda row: list(row["ours"].values()),
        "released": lambda row: [row["released"]] if "released" in row else [],
    }
    for axes, key in zip(figure.subplots(1, len(keys)), keys, strict=True):
        head, factor, most, _ = COLUMNS[key]
        for name, colour in (("ours", "#00796b"), ("released", "#c2185b")):
            values = [factor * one[key] for row in rows for one in pick[name](row)]
            highest = 3 * most
            bins = np.linspace(0.0, highest, 31)
            axes.hist(
                np.clip(values, 0.0, highest - 1e-9),
                bins,
                weights=np.full(len(values), 1 / max(len(values), 1)),
                label=name,
                color=colour,
                alpha=0.6,
            )
        axes.axvline(most, color="black", linewidth=1, linestyle="--")
        axes.set_xlabel(head)
    figure.axes[0].set_ylabel("share of plans")
    figure.axes[0].legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
