"""How far each wrist path takes the grasp point from the motion, by geometry alone: one table.

python benchmark/wrist_paths.py [quick6]
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pgdm.config.store import compose
from pgdm.config.suites import suite
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.wrist.path import carried_path, clipped_path, feasible_path


def row(task: str) -> str:
    """Return a task's row: distances in mm, angles in rad, time in s."""
    builder = env_builder(compose([f"task={task}"]), open_library())
    index, reference = builder.scene.index, builder.mdp.reference
    start = torch.from_numpy(builder.mdp.start.qpos)
    mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
    targets = mount.inv().apply(reference.pos.numpy() - index.mount_pos)

    def turns(path: np.ndarray) -> Rotation:
        return Rotation.from_euler("XYZ", path[:, 3:])

    carried = carried_path(index, reference, start).numpy()
    grasp = turns(carried)[0].inv().apply(targets[0] - carried[0, :3])
    begin = time.perf_counter()
    feasible = feasible_path(index, reference, start).numpy()
    spent = time.perf_counter() - begin
    cells = []
    for path in (clipped_path(index, reference, start).numpy(), feasible):
        off = 1e3 * np.linalg.norm(path[:, :3] + turns(path).apply(grasp) - targets, axis=1)
        cells.append(f"{off.mean():.1f}, {off.max():.1f}")
    given_up = (turns(carried).inv() * turns(feasible)).magnitude()
    cells.append(f"{given_up.mean():.2f}, {given_up.max():.2f}")
    return f"| {task} | {' | '.join(cells)} | {spent:.1f} |"


def main() -> None:
    """Print the table of a suite."""
    print("| task | `clipped`: mean, largest [mm] | `feasible` | orientation given up [rad] | s |")
    print("|---|--:|--:|--:|--:|")
    for task in suite(sys.argv[1] if len(sys.argv) > 1 else "quick6"):
        print(row(task), flush=True)


if __name__ == "__main__":
    main()
