"""Records the last states and actuator targets of simulations, to dump them on divergence."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgdm.sim.batch import Array, SimBatch, Simulations

_log = logging.getLogger(__name__)

KEPT_STEPS = 10
MAX_DUMPS = 20  # so that a broken scene does not fill the disk


class History:
    """A ring buffer of the last ``KEPT_STEPS`` states and actuator targets of all simulations.

    Args:
        sim: the simulations.
        folder: folder of the dumps; None keeps nothing.
    """

    def __init__(self, sim: Simulations, folder: Path | None) -> None:
        self._sim, self._folder = sim, folder
        kept = 0 if folder is None else KEPT_STEPS
        rows = torch.as_tensor(sim.rows)
        self._states = torch.zeros((kept, *rows.shape), dtype=rows.dtype, device=sim.device)
        targets = (kept, sim.num_envs, sim.scene.model.nu)
        self._ctrl = torch.zeros(targets, dtype=torch.float64, device=sim.device)
        self._count = 0

    def record(self, ctrl: Array) -> None:
        """Keep the current states, and the targets (N, nu) about to be applied to them."""
        if self._folder is None:
            return
        slot = self._count % KEPT_STEPS
        self._states[slot] = torch.as_tensor(self._sim.rows)
        self._ctrl[slot] = torch.as_tensor(ctrl)
        self._count += 1

    def dump(self, sims: list[int], steps: list[int]) -> None:
        """Write the last states and targets of simulations to one file each, oldest first.

        The folder gets at most ``MAX_DUMPS`` files; without a folder there is only a warning.

        Args:
            sims: indices of the simulations.
            steps: their control steps since reset; states of earlier episodes are left out.
        """
        _log.warning("%d simulation(s) diverged in '%s'", len(sims), self._sim.scene.task.id)
        if self._folder is None:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        room = MAX_DUMPS - len(list(self._folder.glob("*.npz")))
        for sim, count in list(zip(sims, steps, strict=True))[: max(room, 0)]:
            kept = range(self._count - min(count, KEPT_STEPS, self._count), self._count)
            order = [k % KEPT_STEPS for k in kept]
            content: dict[str, Any] = {
                "states": self._states[order, sim].cpu().numpy(),
                "ctrl": self._ctrl[order, sim].cpu().numpy(),
            }
            if self._sim.scene.index.randomized_geom is not None:
                names = ("friction", "half_width", "mass")
                varied = zip(names, self._sim.variation(), strict=True)
                content |= {name: values[sim] for name, values in varied}
            path = self._folder / f"{time.time_ns()}-sim{sim}.npz"
            np.savez(path, task=np.array(self._sim.scene.task.id), **content)
            _log.warning("last %d states and targets written to %s", len(order), path)


def replay(path: Path, sim: SimBatch) -> np.ndarray:
    """Simulate a dump again.

    Args:
        path: path of the dump.
        sim: one simulation of the same scene.

    Returns:
        The states after each step, (K, nstate); the simulation diverged in the last step.
    """
    with np.load(path) as dump:
        stored = dict(dump)
    if "friction" in stored:
        mass = stored.get("mass", sim.variation()[2][0])  # earlier versions did not randomise it
        drawn = (stored["friction"], stored["half_width"], mass)
        sim.set_variation(np.array([0]), *(np.array([value]) for value in drawn))
    sim.restore(stored["states"][:1])
    after = []
    for target in stored["ctrl"]:
        sim.step(target[None])
        after.append(sim.rows[0].copy())
    return np.array(after)
