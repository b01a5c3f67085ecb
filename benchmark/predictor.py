"""Measure how well pre-grasps are predicted for unseen objects.

    python benchmark/predictor.py [--out FOLDER] [--once] [--no-lift] [TASK ...]

For each object, a predictor is fitted to the pre-grasps of all other objects; its predictions for
the object's tasks are compared with the mined pre-grasps. Writes one JSON file per task, so that a
later call resumes, then the tables of docs/pregrasps/learned.md and a picture. Needs a TCDM
checkout in the library.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.library import Motion, Start, open_library
from pgdm.pregrasp.predict.candidates import Candidate, free_ones, ranked
from pgdm.pregrasp.predict.grasp_vector import GraspFrame
from pgdm.pregrasp.predict.predictor import Example, Predictor, example, fit, off
from pgdm.pregrasp.quality import LiftTest
from pgdm.sim.scene import Scene, build_scene
from pgdm.sim.sheet import Panel, write_sheet

RESULTS = Path(__file__).parent / "results" / "predictor"
HAND = "adroit"
BEST_OF = (1, 8, 32)
CANDIDATES = 4
CHOOSING, JUDGING = 12, 16  # numbers of policies in the lift test
CHOOSING_SEED, JUDGING_SEED = 0, 1  # other policies judge a candidate than those that chose it
SHOWN = ("hammer-use1", "mug-drink3", "stamp-stamp1", "alarmclock-lift")

Case = tuple[Scene, Motion, Example]


def cases() -> list[Case]:
    """Return the hand's tasks whose object is not attached to anything."""
    library, found = open_library(), []
    for task in available("task"):
        cfg = compose([f"task={task}"])
        if cfg.hand.name == HAND:
            scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
            motion = library.motion(cfg.task.motion)
            one = example(scene, motion.starts["mined"].qpos)
            if one is not None:
                found.append((scene, motion, one))
    return found


def nearest(train: Sequence[Example], wanted: Example) -> np.ndarray:
    """Return the vector (9+J,) of the pre-grasp whose object has the nearest code."""
    return min(train, key=lambda e: float(np.linalg.norm(e.code - wanted.code))).vector


def best_of(
    frame: GraspFrame, predictor: Predictor, one: Example, count: int, rounds: int = 8
) -> float:
    """Return the expected fingertip error of the best of ``count`` samples, m."""
    found = []
    for seed in range(rounds):
        samples = predictor.sample(one.code, count, seed)
        found.append(min(off(frame, vector, one) for vector in samples))
        if count == 1:  # the mean does not depend on the seed
            break
    return float(np.mean(found))


def measure(case: Case, every: Sequence[Example], with_lift: bool) -> dict[str, Any]:
    """Return the results of one task."""
    scene, motion, one = case
    train = [e for e in every if e.object != one.object]
    began = time.monotonic()
    learned = fit(train, GraspFrame(scene))
    mean = fit(train, GraspFrame(scene), penalties=(np.inf,))
    row: dict[str, Any] = {"task": one.task, "object": one.object, "penalty": learned.penalty}
    frame, palm = GraspFrame(scene, learned.anchor_m), GraspFrame(scene)
    for name, predictor in (("learned", learned), ("mean_hand", mean)):
        for count in BEST_OF:
            row[f"{name}_best_of_{count}_m"] = best_of(frame, predictor, one, count)
    row["nearest_m"] = off(palm, nearest(train, one), one)
    for kind in ("planned", "learned"):
        if kind in motion.starts:
            tips = palm.fingertips(motion.starts[kind].qpos)
            away = np.linalg.norm(tips - one.fingertips, axis=1)
            row[f"stored_{kind}_m"] = float(away.mean())
    if with_lift:
        row |= lifts(case, frame, palm, {"learned": learned, "mean_hand": mean}, train)
    return row | {"seconds": time.monotonic() - began}


def lifts(
    case: Case,
    frame: GraspFrame,
    palm: GraspFrame,
    predictors: dict[str, Predictor],
    train: Sequence[Example],
) -> dict[str, Any]:
    """Return the lift rates of a task's stored and predicted pre-grasps, made free of contact."""
    scene, motion, one = case
    objects, row = motion.starts["mined"].qpos, {}
    choose = LiftTest(scene, motion.substeps, CHOOSING, CHOOSING_SEED)
    judge = LiftTest(scene, motion.substeps, JUDGING, JUDGING_SEED)

    def rate(qpos: np.ndarray) -> float:
        return judge(Start(qpos, np.zeros_like(qpos), None))

    for kind, start in motion.starts.items():
        row[f"stored_{kind}_lift"] = rate(start.qpos)
    for name, predictor in predictors.items():
        first = free_ones(frame, predictor.sample(one.code, 1), objects)[0]
        row |= metrics(f"{name}_first", first, rate, frame, one)
        samples = predictor.sample(one.code, 3 * CANDIDATES)
        chosen = ranked(free_ones(frame, samples, objects)[:CANDIDATES], choose)[0]
        row |= metrics(f"{name}_chosen", chosen, rate, frame, one)
    moved = free_ones(palm, [nearest(train, one)], objects)[0]
    return row | metrics("nearest", moved, rate, frame, one)


def metrics(
    name: str, candidate: Candidate, rate: Any, frame: GraspFrame, one: Example
) -> dict[str, Any]:
    """Return the metrics of one candidate."""
    away = np.linalg.norm(frame.fingertips(candidate.qpos) - one.fingertips, axis=1)
    return {
        f"{name}_lift": rate(candidate.qpos),
        f"{name}_moved_m": candidate.moved_m,
        f"{name}_free_error_m": float(away.mean()),
        f"{name}_qpos": candidate.qpos.round(6).tolist(),
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the results as tables in Markdown."""
    objects = len({row["object"] for row in rows})
    lines = [f"{len(rows)} tasks, {objects} objects, each left out in turn.", ""]
    lines += ["| fingertip error [mm] | mean | median | best of 8 | best of 32 |", "|---" * 5 + "|"]
    for name, label in (("learned", "learned"), ("mean_hand", "mean hand")):
        one, eight, more = (column(rows, f"{name}_best_of_{n}_m") for n in BEST_OF)
        cells = (np.mean(one), np.median(one), np.mean(eight), np.mean(more))
        lines.append(f"| {label} | " + " | ".join(f"{1e3 * c:.1f}" for c in cells) + " |")
    away = column(rows, "nearest_m")
    cells = f"{1e3 * np.mean(away):.1f} | {1e3 * np.median(away):.1f}"
    lines += [f"| nearest object's | {cells} | | |", ""]
    better = np.mean(column(rows, "learned_best_of_1_m") < column(rows, "mean_hand_best_of_1_m"))
    lines += [f"Learned is nearer than the mean hand in {better:.0%} of the tasks.", ""]
    tested = [row for row in rows if "stored_mined_lift" in row]
    if tested:
        lines += [f"Lift test, {len(tested)} tasks:", ""]
        lines += ["| start | lift rate | tasks with any lift | fingertip error [mm] |"]
        lines += ["|---" * 4 + "|"]
    for name in (
        *("stored_mined", "stored_planned", "mean_hand_first", "learned_first", "nearest"),
        *("mean_hand_chosen", "learned_chosen"),
    ):
        rates = column(tested, f"{name}_lift")
        if len(rates):
            error = column(tested, f"{name}_free_error_m")
            shown = f"{1e3 * error.mean():.1f}" if len(error) else ""
            label = name.replace("_", " ")
            cells = f"{rates.mean():.1%} | {(rates > 0).sum()} | {shown}"
            lines.append(f"| {label} | {cells} |")
    for row in rows:
        if "stored_learned_m" in row:
            lift = f"lift rate {row.get('stored_learned_lift', float('nan')):.0%}"
            ours = f"ours {1e3 * row['learned_best_of_1_m']:.0f} mm"
            published = f"{1e3 * row['stored_learned_m']:.0f} mm from mined, {lift}"
            lines += ["", f"Published learned start of {row['task']}: {published}; {ours}."]
    return "\n".join(lines) + "\n"


def column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """Return a column's values of the rows that have it."""
    return np.array([row[name] for row in rows if row.get(name) is not None], float)


def picture(found: list[Case], rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Write a picture of stored, mean and learned hands, one row per task of a few."""
    sheets = []
    with tempfile.TemporaryDirectory() as folder:
        for scene, motion, one in found:
            row = rows.get(one.task, {})
            if one.task in SHOWN and "learned_chosen_qpos" in row:
                stored = Panel(motion.starts["mined"].qpos, f"{one.task}  stored", text(row, ""))
                panels = [stored]
                for name in ("mean_hand_first", "learned_chosen"):
                    qpos = np.array(row[f"{name}_qpos"])
                    panels.append(Panel(qpos, name.replace("_", " "), text(row, name)))
                file = write_sheet(scene, panels, Path(folder) / f"{one.task}.png")
                sheets.append(np.asarray(Image.open(file).convert("RGB")))
    if sheets:
        whole = Image.fromarray(np.concatenate(sheets))
        whole.resize((whole.width // 2, whole.height // 2)).save(path, quality=85)


def text(row: dict[str, Any], name: str) -> str:
    """Return the line below a picture."""
    if not name:
        return f"lift rate {row['stored_mined_lift']:.0%}"
    error = 1e3 * row[f"{name}_free_error_m"]
    return f"lift rate {row[f'{name}_lift']:.0%}, fingertips {error:.0f} mm off"


def main() -> None:
    """Measure what is missing, then write the tables and the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="only these")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"[{RESULTS}]")
    parser.add_argument("--no-lift", action="store_true", help="only fingertip errors; not stored")
    parser.add_argument("--once", action="store_true", help="only one task per object")
    arguments = parser.parse_args()
    found = cases()
    every = [one for _, _, one in found]
    rows: dict[str, dict[str, Any]] = {}
    arguments.out.mkdir(parents=True, exist_ok=True)
    turns = [sum(other.object == one.object for other in every[:i]) for i, one in enumerate(every)]
    # First one task of every object.
    for turn, i in sorted((turn, i) for i, turn in enumerate(turns)):
        case, task = found[i], every[i].task
        if (arguments.tasks and task not in arguments.tasks) or (arguments.once and turn > 0):
            continue
        file = arguments.out / f"{task}.json"
        if not file.is_file() or arguments.no_lift:
            row = measure(case, every, not arguments.no_lift)
            if not arguments.no_lift:
                file.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
            rows[task] = row
        else:
            rows[task] = json.loads(file.read_text(encoding="utf-8"))
        print(f"{len(rows)}/{len(found)} {task} {rows[task]['seconds']:.0f} s", flush=True)
    tables = summary(list(rows.values()))
    if not arguments.no_lift:
        (arguments.out / "summary.md").write_text(tables, encoding="utf-8")
        picture(found, rows, arguments.out / "candidates.jpg")
    print(tables)


if __name__ == "__main__":
    main()
