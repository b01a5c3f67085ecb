"""Per-reset variation of a simulation's contact (SPEC 5, R)."""

from __future__ import annotations

from typing import Any

import numpy as np

from pgdm.seeding import numpy_stream
from pgdm.sim.batch import SimBatch

# Uniform ranges of the released real-world check: friction (slide, spin, roll), box half-width.
FRICTION_LOW = (0.3, 0.0001, 0.00001)
FRICTION_HIGH = (0.7, 0.005, 0.0002)
HALF_WIDTH_M = (0.015, 0.033)


class Randomizer:
    """Draws friction and half-width for every simulation that restarts.

    Args:
        seed: of the stream it draws from.
        stream: name of that stream, so that training and evaluation draw apart.
        num_envs: N.
    """

    def __init__(self, seed: int, stream: str, num_envs: int) -> None:
        self._stream = f"randomize-{stream}"
        self._rng = numpy_stream(seed, self._stream)
        self._friction = np.zeros((num_envs, 3))
        self._half_width = np.zeros(num_envs)

    def apply(self, sim: SimBatch, ids: np.ndarray) -> None:
        """Draw anew for simulations ids (k,)."""
        self._friction[ids] = self._rng.uniform(FRICTION_LOW, FRICTION_HIGH, (len(ids), 3))
        self._half_width[ids] = self._rng.uniform(*HALF_WIDTH_M, len(ids))
        sim.set_contact(ids, self._friction[ids], self._half_width[ids])

    def reseed(self, seed: int) -> None:
        """Start the stream of another seed."""
        self._rng = numpy_stream(seed, self._stream)

    def state_dict(self) -> dict[str, Any]:
        """Return the drawn values and the stream's state."""
        return {
            "rng": self._rng.bit_generator.state,
            "friction": self._friction.tolist(),
            "half_width": self._half_width.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any], sim: SimBatch) -> None:
        """Continue from ``state_dict`` and put its values into the simulations."""
        self._rng.bit_generator.state = state["rng"]
        self._friction = np.array(state["friction"])
        self._half_width = np.array(state["half_width"])
        sim.set_contact(np.arange(sim.num_envs), self._friction, self._half_width)
