"""Randomisation of the object at every reset (paper, App. E: real-world experiment)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from pgdm.seeding import numpy_stream
from pgdm.sim.batch import Array, Simulations

# Uniform ranges: friction (slide, spin, roll) and half-width of the box are those of the released
# code. The paper varies the mass too and gives no range: ours spans the model's 0.145 kg and the
# 0.411 kg of the real cracker box (YCB object set, table 1).
FRICTION_LOW = (0.3, 0.0001, 0.00001)
FRICTION_HIGH = (0.7, 0.005, 0.0002)
HALF_WIDTH_M = (0.015, 0.033)
MASS_KG = (0.1, 0.45)


class Randomizer:
    """Draws friction, half-width and mass for every simulation that is reset.

    Args:
        seed: seed of the random stream.
        stream: name of the stream; training and evaluation have separate ones.
        num_envs: N.
    """

    def __init__(self, seed: int, stream: str, num_envs: int) -> None:
        self._stream = f"randomize-{stream}"
        self._rng = numpy_stream(seed, self._stream)
        self._friction = np.zeros((num_envs, 3))
        self._half_width = np.zeros(num_envs)
        self._mass = np.zeros(num_envs)

    def apply(self, sim: Simulations, ids: Array) -> None:
        """Draw new values for simulations ids (k,) and set them."""
        ids = np.asarray(torch.as_tensor(ids).cpu())
        self._friction[ids] = self._rng.uniform(FRICTION_LOW, FRICTION_HIGH, (len(ids), 3))
        self._half_width[ids] = self._rng.uniform(*HALF_WIDTH_M, len(ids))
        self._mass[ids] = self._rng.uniform(*MASS_KG, len(ids))
        sim.set_variation(ids, self._friction[ids], self._half_width[ids], self._mass[ids])

    def reseed(self, seed: int) -> None:
        """Restart the stream with another seed."""
        self._rng = numpy_stream(seed, self._stream)

    def state_dict(self) -> dict[str, Any]:
        """Return the current values and the state of the stream."""
        return {
            "rng": self._rng.bit_generator.state,
            "friction": self._friction.tolist(),
            "half_width": self._half_width.tolist(),
            "mass": self._mass.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any], sim: Simulations) -> None:
        """Restore a ``state_dict`` and set its values in the simulations."""
        self._rng.bit_generator.state = state["rng"]
        self._friction = np.array(state["friction"])
        self._half_width = np.array(state["half_width"])
        # Checkpoints of earlier versions, which did not randomise the mass, lack it.
        self._mass = np.array(state.get("mass", sim.variation()[2]))
        ids = np.arange(sim.num_envs)
        sim.set_variation(ids, self._friction, self._half_width, self._mass)
