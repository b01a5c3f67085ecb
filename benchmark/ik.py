"""Measure how well inverse kinematics follows human hands, for every task and every hand.

    python benchmark/ik.py [--tasks hammer-use1 cup-pour1] [--hands adroit dhand dmanus]

A pose is a success if every measured fingertip is within 2 cm of its target (the human's fingertip;
if Adroit follows a whole human hand, that of the human hand scaled to Adroit's bone lengths, as in
the published trajectories), the hand penetrates nothing, and all joints are within their limits. If
the library has no human hand for a task, the task's own hand at the mined pre-grasp is followed.
For Adroit, the distance from the mined pre-grasps is measured too, and the distance of these from
the published trajectory of the same hand in the same frame. Results are stored as they are
computed; a second call resumes. Needs the assets of a TCDM checkout and the experts.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.config.hands import own_hand
from pgdm.library import open_library
from pgdm.library.progress import ProgressLines
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.retarget.hand_ik import HandIk
from pgdm.pregrasp.retarget.mocap import of_task, retarget
from pgdm.sim.contact import FREE_M
from pgdm.sim.scene import Scene, build_scene

FOLDER = Path(__file__).parent / "results" / "ik"
HANDS = ("adroit", "dhand", "dmanus")
FINGERS = slice(8, 30)
"""Adroit's finger joints."""


def fingertips(ik: HandIk, qpos: np.ndarray) -> np.ndarray:
    """Return the fingertips (F, 3) m."""
    return posed(ik.scene, qpos).geom_xpos[ik.scene.index.point_geoms[ik.shape.rows[:, 2]]]


def rms(a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square of a difference."""
    return float(np.sqrt(((a - b) ** 2).mean()))


def measure(task: str, hand: str) -> dict[str, Any]:
    """Return the metrics of one hand for one task."""
    library = open_library()
    cfg = compose([f"task={task}", f"hand={hand}"])
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    motion = library.motion(cfg.task.motion)
    own = build_scene(library, cfg.task, own_hand(cfg, library), cfg.sim)
    recording = of_task(library, own, motion)
    begun = time.monotonic()
    made = retarget(scene, library, motion, recording)
    seconds = time.monotonic() - begun
    qpos, depth = made.result.qpos, made.result.depth_m
    low, high = scene.model.jnt_range[: scene.model.nu].T
    inside = bool(((qpos[: len(low)] >= low) & (qpos[: len(low)] <= high)).all())
    errors = 1e3 * made.errors_m
    found = {
        "human": motion.id in library.experts().experts,
        "success": bool(errors.max() <= 20 and depth <= FREE_M and inside),
        "fingertips_mm": float(errors.mean()),
        "worst_mm": float(errors.max()),
        "depth_mm": 1e3 * depth,
        "within_limits": inside,
        "anchor": made.result.targets.anchor,
        "palm_rad": made.result.palm_error_rad,
        "unreachable": made.unreachable,
        "seconds": seconds,
    }
    if hand == "adroit" and found["human"]:
        found |= published(scene, task, qpos)
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in found.items()}


def published(scene: Scene, task: str, qpos: np.ndarray) -> dict[str, float]:
    """Return how far Adroit's pose and the expert's are from the mined pre-grasp."""
    library, ik = open_library(), HandIk(scene)
    mined = library.motion(task).starts["mined"].qpos
    expert = np.concatenate((library.expert(task).qpos[0], mined[30:]))
    tips = fingertips(ik, mined)

    def away(other: np.ndarray) -> float:
        return 1e3 * float(np.linalg.norm(fingertips(ik, other) - tips, axis=1).mean())

    return {
        "published_fingers_rad": rms(qpos[FINGERS], mined[FINGERS]),
        "published_fingertips_mm": away(qpos),
        "published_depth_mm": 1e3 * ik.contact.depth(mined),
        "expert_fingers_rad": rms(expert[FINGERS], mined[FINGERS]),
        "expert_fingertips_mm": away(expert),
        "expert_depth_mm": 1e3 * ik.contact.depth(expert),
    }


def table(found: dict[str, dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    lines = [
        "# Inverse kinematics\n",
        "`python benchmark/ik.py`, which defines success.\n",
        "| hand | followed | tasks | success | fingertips, mean | worst finger, median | "
        "penetration > 0 | s |",
        "|---|---|--:|--:|--:|--:|--:|--:|",
    ]
    for hand in HANDS:
        for human, name in ((True, "human hands"), (False, "the task's own hand")):
            rows = [r for k, r in found.items() if k.endswith(f"/{hand}") and r["human"] == human]
            if rows:
                cut = sum(r["depth_mm"] > 1e3 * FREE_M for r in rows)
                lines.append(
                    f"| {hand} | {name} | {len(rows)} | {sum(r['success'] for r in rows)} | "
                    f"{mean(rows, 'fingertips_mm'):.1f} mm | {median(rows, 'worst_mm'):.1f} mm | "
                    f"{cut} | {median(rows, 'seconds'):.1f} |"
                )
    rows = [r for r in found.values() if "published_fingers_rad" in r]
    if rows:
        lines += [
            f"\n## Against the {len(rows)} mined pre-grasps of Adroit\n",
            "| | fingers, RMS | fingertips | penetration, worst |",
            "|---|--:|--:|--:|",
        ]
        cut = max(r["depth_mm"] for r in rows)
        for name, key, depth in (
            ("inverse kinematics", "published", cut),
            ("published trajectory, frame 0", "expert", max(r["expert_depth_mm"] for r in rows)),
        ):
            lines.append(
                f"| {name} | {mean(rows, f'{key}_fingers_rad'):.3f} rad (median "
                f"{median(rows, f'{key}_fingers_rad'):.3f}) | "
                f"{mean(rows, f'{key}_fingertips_mm'):.1f} mm (median "
                f"{median(rows, f'{key}_fingertips_mm'):.1f}) | {depth:.1f} mm |"
            )
    lines += [
        "\n## Failures\n",
        "| task | hand | worst | what is unreachable |",
        "|---|---|--:|---|",
    ]
    lines += [
        f"| {key.split('/')[0]} | {key.split('/')[1]} | {r['worst_mm']:.0f} mm | "
        f"{'; '.join(r['unreachable'])} |"
        for key, r in sorted(found.items())
        if not r["success"]
    ]
    return "\n".join(lines) + "\n"


def mean(rows: list[dict[str, Any]], key: str) -> float:
    """Return the mean of a metric."""
    return float(np.mean([row[key] for row in rows]))


def median(rows: list[dict[str, Any]], key: str) -> float:
    """Return the median of a metric."""
    return float(np.median([row[key] for row in rows]))


def main() -> None:
    """Measure what is missing, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=[t for t in available("task") if t[0] != "_"])
    parser.add_argument("--hands", nargs="+", default=HANDS, choices=HANDS)
    chosen = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    stored = FOLDER / "ik.json"
    found = json.loads(stored.read_text()) if stored.is_file() else {}
    todo = [(t, h) for t in chosen.tasks for h in chosen.hands if f"{t}/{h}" not in found]
    say = ProgressLines(print)
    for i, (task, hand) in enumerate(todo):
        say("tasks", i, len(todo))
        found[f"{task}/{hand}"] = measure(task, hand)
        stored.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
        (FOLDER / "README.md").write_text(table(found))
    print(table(found))


if __name__ == "__main__":
    main()
