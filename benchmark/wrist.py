"""Measure how closely hands can follow the motions: by geometry, and simulated without the object.

    python benchmark/wrist.py                plan all 51 tasks unless stored, print the table
    python benchmark/wrist.py quick6         only the tasks of a suite
    python benchmark/wrist.py --table        print the table of the stored results

Results are stored task by task in results/wrist.json; plans are stored in the library, where
runs find them. Times are comparable only if the machine is idle.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pgdm.config.compose import compose
from pgdm.config.schema import ExperimentCfg
from pgdm.config.suites import suite
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import assets, env_builder
from pgdm.motion.reference import ObjectReference
from pgdm.rl.evaluate import run_episodes
from pgdm.rl.sac import SACCfg, SACLearner
from pgdm.runs.files import read_json, write_json
from pgdm.seeding import torch_stream
from pgdm.sim.scene import SceneIndex
from pgdm.wrist.path import SLIDES, GraspPoint, base_orientation, clipped_path, feasible_path
from pgdm.wrist.plan import WristPlan

RESULTS = Path(__file__).parent / "results" / "wrist.json"
TASKS = (*suite("tcdm50"), "dmanus-sim2real")


def key(task: str) -> str:
    """Return a hash of everything that a row depends on."""
    cfg = compose([f"task={task}", "+experiment=fast", "action.wrist_path=clipped"])
    return env_builder(cfg, assets(cfg, print), print).wrist_problem.key()


def measure(task: str) -> dict[str, Any]:
    """Return a task's values: distances in mm, bounds as shares, times in s."""
    cfg = compose([f"task={task}", "+experiment=fast"])
    free = replace(cfg, action=replace(cfg.action, hold_steps=0))
    builder, unheld = (env_builder(c, assets(c, print), print) for c in (cfg, free))
    assert builder.wrist is not None and unheld.wrist is not None
    return {
        "steps": len(builder.wrist.error_m),
        **geometry(builder),
        "planned": reached(unheld.wrist),
        "held": reached(builder.wrist),
        "hold_steps": cfg.action.hold_steps,
        "untrained": {
            "carried": untrained(compose([f"task={task}", "action=residual"])),
            "planned": untrained(cfg),
        },
        "paper_success": cfg.task.paper_success,
    }


def untrained(cfg: ExperimentCfg) -> float:
    """Return the mean return of 25 episodes of the untrained policy of `algo=sac`, seed 0."""
    builder, sac = env_builder(cfg, assets(cfg, print), print), compose(["algo=sac"]).algo
    assert isinstance(sac, SACCfg)
    evaluation = builder.make(25, stream="eval_sampled")
    policy = SACLearner(evaluation, sac, 0, 1, None, "cpu", 1).model
    results = run_episodes(evaluation, policy, torch_stream(0, "eval"))
    assert results is not None
    return round(float(results["return"].mean()), 1)


def geometry(builder: EnvBuilder) -> dict[str, float]:
    """Return the grasp point's mean distance from the motion on the clipped and feasible path."""
    index, reference = builder.scene.index, builder.mdp.reference
    start = torch.from_numpy(builder.mdp.start.qpos)
    result = {}
    for name, path_of in (("clipped", clipped_path), ("feasible", feasible_path)):
        path = path_of(index, reference, start).numpy()
        off = grasp_errors(index, reference, start.numpy(), path)
        result[f"{name}_mm"] = round(1e3 * float(off.mean()), 1)
    return result


def grasp_errors(
    index: SceneIndex, reference: ObjectReference, start: np.ndarray, path: np.ndarray
) -> np.ndarray:
    """Return the grasp point's distance from the motion on a path, (T,) m.

    Args:
        index: index of the scene.
        reference: the exemplar motion.
        start: qpos (nq,) at the start.
        path: base joints (T, 6), m and rad.
    """
    mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
    targets = mount.inv().apply(reference.pos.numpy() - index.mount_pos)  # in the mount's frame
    grasp = GraspPoint.at(targets[0], start[:SLIDES], base_orientation(start))
    return np.linalg.norm(grasp.of(path[:, :SLIDES], base_orientation(path)) - targets, axis=1)


def reached(plan: WristPlan) -> dict[str, float]:
    """Return what the hand alone reaches with a plan."""
    return {
        "mean_mm": round(1e3 * float(plan.error_m.mean()), 1),
        "max_mm": round(1e3 * float(plan.error_m.max()), 1),
        "bound": round(plan.rigid_grasp, 3),
        "frames": plan.frames,
        "seconds": round(plan.seconds, 1),
    }


def table(stored: dict[str, Any]) -> str:
    """Return the stored results as a Markdown table, lowest `planned` rigid grasp first."""
    lines = [
        "| task | steps | `clipped`, `feasible`: mean [mm] | `planned`: mean, largest [mm] "
        "| rigid grasp | with the hold | frames | paper | untrained return: `carried`, `planned` |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for task, row in sorted(stored.items(), key=lambda item: item[1]["planned"]["bound"]):
        free, held, paper = row["planned"], row["held"], row["paper_success"]
        lines.append(
            f"| {task} | {row['steps']} | {row['clipped_mm']}, {row['feasible_mm']} "
            f"| {free['mean_mm']}, {free['max_mm']} | {free['bound']:.1%} "
            f"| {held['bound']:.1%} | {held['frames']:,} "
            f"| {'' if paper is None else f'{paper:.1%}'} "
            f"| {row['untrained']['carried']:.0f}, {row['untrained']['planned']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Plan what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", nargs="?", help="suite to plan [all 51 tasks]")
    parser.add_argument("--table", action="store_true", help="only print what is stored")
    args = parser.parse_args()
    stored = read_json(RESULTS) if RESULTS.is_file() else {}
    for task in () if args.table else suite(args.suite) if args.suite else TASKS:
        if stored.get(task, {}).get("key") != key(task):
            stored[task] = {"key": key(task), **measure(task)}
            print(task, json.dumps(stored[task]), flush=True)
            write_json(RESULTS, stored)
    print(table(stored))


if __name__ == "__main__":
    main()
