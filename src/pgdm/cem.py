"""The cross-entropy method: a diagonal Gaussian that narrows around its best samples.

A round draws x_i ~ N(m, diag(s^2)), takes the ``elites`` samples of least cost, and sets

    m <- k m + (1 - k) mean(elites)
    s <- max(k s + (1 - k) std(elites), least s_0) + added s_0

with ``k`` the smoothing and ``s_0`` the first standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CemCfg:
    """How the Gaussian follows its samples."""

    population: int
    """Samples per round."""
    elites: int
    """Number of lowest-cost samples to which a round fits the Gaussian."""
    smoothing: float = 0.0
    """Share of the old mean and standard deviation that a round keeps (0..1)."""
    least: float = 0.0
    """Lower bound of the standard deviation, as a share of the first one: keeps the Gaussian from
    collapsing early."""
    added: float = 0.0
    """Share of the first standard deviation added in each round, also against early collapse."""


class CrossEntropy:
    """A search for the vector of least cost.

    Args:
        mean: mean of the first samples (D,).
        std: standard deviation of the first samples (D,).
        cfg: settings of the search.
        random: random stream of the samples.
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
        """Refit the Gaussian to the best of samples (N, D) with costs (N,).

        Returns the elites' indices, best first. Samples whose cost is not finite are never elites,
        even if fewer than ``elites`` remain; without any elite the Gaussian stays as it is.
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
