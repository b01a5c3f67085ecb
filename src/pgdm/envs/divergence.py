"""The last states and actions of every simulation, kept for the ones that diverge."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.sim.batch import SimBatch

_log = logging.getLogger(__name__)

KEPT_STEPS = 10
MAX_DUMPS = 20  # a badly broken scene must not fill the disk


class History:
    """A ring of the last ``KEPT_STEPS`` states and targets of all simulations.

    Args:
        sim: the simulations.
        folder: where dumps go; None keeps nothing.
    """

    def __init__(self, sim: SimBatch, folder: Path | None) -> None:
        self._sim, self._folder = sim, folder
        n, nu = sim.num_envs, sim.scene.model.nu
        self._states = np.zeros((KEPT_STEPS, n, sim.rows.shape[1]))
        self._ctrl = np.zeros((KEPT_STEPS, n, nu))
        self._count = 0

    def record(self, ctrl: np.ndarray) -> None:
        """Keep the states as they are, and the targets (N, nu) about to be applied to them."""
        if self._folder is None:
            return
        slot = self._count % KEPT_STEPS
        self._states[slot] = self._sim.rows
        self._ctrl[slot] = ctrl
        self._count += 1

    def dump(self, sims: list[int], steps: list[int]) -> None:
        """Write the last states and targets of simulations, oldest first, to one file each.

        Args:
            sims: which simulations.
            steps: their control steps since reset, so that nothing of an earlier episode is kept.
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
                "states": self._states[order, sim],
                "ctrl": self._ctrl[order, sim],
            }
            if self._sim.scene.index.randomized_geom is not None:
                friction, half_width = self._sim.contact()
                content |= {"friction": friction[sim], "half_width": half_width[sim]}
            path = self._folder / f"{time.time_ns()}-sim{sim}.npz"
            np.savez(path, task=np.array(self._sim.scene.task.id), **content)
            _log.warning("its last %d states and targets: %s", len(order), path)


def replay(path: Path, sim: SimBatch) -> np.ndarray:
    """Step a dump again in ``sim``, one simulation of the same scene.

    Returns:
        The states after each step, (K, nstate); the last one is where it diverged.
    """
    with np.load(path) as dump:
        stored = dict(dump)
    if "friction" in stored:
        sim.set_contact(np.array([0]), stored["friction"][None], stored["half_width"][None])
    sim.restore(stored["states"][:1])
    after = []
    for target in stored["ctrl"]:
        sim.step(target[None])
        after.append(sim.rows[0].copy())
    return np.array(after)
