"""The cross-entropy method: a Gaussian that narrows around the best of its samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CemCfg:
    """How a Gaussian follows its samples."""

    population: int
    """Samples of a round."""
    elites: int
    """Of them, how many the next ones are drawn around."""
    smoothing: float = 0.0
    """Share of the old mean and deviation that a round keeps (0..1)."""
    least: float = 0.0
    """Share of the first deviation below which none falls, so that the search does not freeze."""
    added: float = 0.0
    """Share of the first deviation that is added to the elites', for the same reason."""


class CrossEntropy:
    """A search for the vector of least cost.

    Args:
        mean: of the first samples (D,).
        std: their deviation (D,).
        cfg: how to search.
        random: where the samples come from.
    """

    def __init__(
        self, mean: np.ndarray, std: np.ndarray, cfg: CemCfg, random: np.random.Generator
    ) -> None:
        self.mean, self.std = mean.copy(), std.copy()
        self._least, self._added = cfg.least * std, cfg.added * std
        self._cfg, self._random = cfg, random

    def ask(self) -> np.ndarray:
        """Return samples (population, D)."""
        noise = self._random.standard_normal((self._cfg.population, len(self.mean)))
        return self.mean + self.std * noise

    def tell(self, samples: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """Learn what samples (N, D) cost (N,); return the rows of the elites, best first.

        Samples of infinite cost are no elites, however few there are.
        """
        elites = np.argsort(cost, kind="stable")[: self._cfg.elites]
        elites = elites[np.isfinite(cost[elites])]
        if not len(elites):
            return elites
        keep = self._cfg.smoothing
        self.mean = keep * self.mean + (1 - keep) * samples[elites].mean(0)
        self.std = keep * self.std + (1 - keep) * samples[elites].std(0)
        self.std = np.maximum(self.std, self._least) + self._added
        return elites
