"""The last states and actions of every simulation, kept for the ones that diverge."""

from __future__ import annotations

import logging
from pathlib import Path

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
        self._dumped = 0

    def record(self, ctrl: np.ndarray) -> None:
        """Keep the states as they are, and the targets (N, nu) about to be applied to them."""
        if self._folder is None:
            return
        slot = self._count % KEPT_STEPS
        self._states[slot] = self._sim.rows
        self._ctrl[slot] = ctrl
        self._count += 1

    def dump(self, sims: list[int]) -> None:
        """Write the ring's rows of simulations ``sims``, oldest first, to one file each."""
        _log.warning("%d simulation(s) diverged in '%s'", len(sims), self._sim.scene.task.id)
        if self._folder is None:
            return
        order = [i % KEPT_STEPS for i in range(max(0, self._count - KEPT_STEPS), self._count)]
        for sim in sims[: MAX_DUMPS - self._dumped]:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{self._dumped:02d}-step{self._count}-sim{sim}.npz"
            np.savez(
                path,
                states=self._states[order, sim],
                ctrl=self._ctrl[order, sim],
                task=np.array(self._sim.scene.task.id),
            )
            self._dumped += 1
            _log.warning("its last %d states and targets: %s", len(order), path)


def replay(path: Path, sim: SimBatch) -> np.ndarray:
    """Step a dump again in ``sim`` (one simulation of the same scene).

    Returns:
        The states after each step, (K, nstate); the last one is where it diverged.
    """
    with np.load(path) as dump:
        states, ctrl = dump["states"], dump["ctrl"]
    sim.restore(states[:1])
    after = []
    for target in ctrl:
        sim.step(target[None])
        after.append(sim.rows[0].copy())
    return np.array(after)
