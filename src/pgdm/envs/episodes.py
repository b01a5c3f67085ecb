"""Episodes of a batch: sums while they run, and metrics when they finish."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pgdm.mdp.metrics import Episodes, episode_metrics
from pgdm.mdp.recipe import Recipe
from pgdm.motion.reference import ObjectReference
from pgdm.sim.batch import SimState


@dataclass(frozen=True)
class FinishedEpisodes:
    """k finished episodes of one task.

    Metrics are computed on demand; one call for many episodes costs about as much as for one.
    """

    reference: ObjectReference
    recipe: Recipe
    episodes: Episodes
    sums: Tensor  # (2, K, k) sum of each reward term over the episode: weighted, then raw
    measured: Tensor  # (2, M, k) each measure's sum over the steps where it applies, their number
    flags: Tensor  # (1 + E, k) bool: diverged, then each of the recipe's ends

    def metrics(self) -> dict[str, Tensor]:
        """Return each metric's values, (k,) float64; see `pgdm.mdp.metrics.episode_metrics`.

        In addition: ``return``, the sum of the rewards without shaping; ``shaping``, the sum of
        those that shaping adds, if any; ``diverged`` and ``end/<name>``, 0 or 1; the mean of each
        measure under its name, NaN if it never applied; and the sum of each reward term over the
        episode, ``term/<name>`` weighted and ``raw/<name>`` unweighted.
        """
        metrics = episode_metrics(self.episodes, self.reference, self.recipe.metrics)
        added = torch.tensor([term.shaping for term in self.recipe.rewards])
        metrics["return"] = self.sums[0][~added].sum(0)
        if added.any():
            metrics["shaping"] = self.sums[0][added].sum(0)
        names = ["diverged", *(f"end/{end.name}" for end in self.recipe.ends)]
        metrics |= dict(zip(names, self.flags.double(), strict=True))
        for kind, sums in zip(("term", "raw"), self.sums, strict=True):
            terms = zip(self.recipe.rewards, sums, strict=True)
            metrics |= {f"{kind}/{term.name}": total for term, total in terms}
        total, steps = self.measured
        names = [measure.name for measure in self.recipe.measures]
        return metrics | dict(zip(names, total / steps, strict=True))  # no step: 0/0 is NaN

    def with_later(self, later: Sequence[FinishedEpisodes]) -> FinishedEpisodes:
        """Return one object with these and then later episodes of the same task."""
        every = (self, *later)
        return FinishedEpisodes(
            self.reference,
            self.recipe,
            Episodes(
                torch.cat([f.episodes.pos for f in every]),
                torch.cat([f.episodes.quat for f in every]),
                torch.cat([f.episodes.length for f in every]),
            ),
            torch.cat([f.sums for f in every], -1),
            torch.cat([f.measured for f in every], -1),
            torch.cat([f.flags for f in every], -1),
        )


class RunningEpisodes:
    """Object poses, reward terms and measures of the running episodes of N simulations.

    Args:
        num_envs: N.
        reference: the exemplar motion, T poses.
        recipe: recipe with K reward terms and M measures.

    The tensors are on the device of the reference.
    """

    def __init__(self, num_envs: int, reference: ObjectReference, recipe: Recipe) -> None:
        self._reference, self._recipe = reference, recipe
        self._rows = torch.arange(num_envs, device=reference.pos.device)
        horizon, zeros = len(reference), reference.pos.new_zeros
        # Sum of each reward term over the episode, (2, K, N): weighted, then raw.
        self._sums = zeros(2, len(recipe.rewards), num_envs)
        # Of each measure, (2, M, N): sum over the steps in which it applies, and their number.
        self._measured = zeros(2, len(recipe.measures), num_envs)
        self._pos, self._quat = zeros(num_envs, horizon, 3), zeros(num_envs, horizon, 4)

    @property
    def start_height(self) -> Tensor:
        """Height of the object's centre of mass at reset, (N,) m."""
        return self._pos[:, 0, 2]

    def restart(self, rows: Tensor) -> None:
        """Clear the sums of rows (k,)."""
        self._sums[:, :, rows] = 0.0
        self._measured[:, :, rows] = 0.0

    def place(self, rows: Tensor, pos: Tensor, quat: Tensor) -> None:
        """Set the object's pose at reset in rows (k,): positions (k, 3), quaternions (k, 4)."""
        self._pos[rows, 0], self._quat[rows, 0] = pos, quat

    def add(self, terms: Tensor, raw: Tensor, measures: dict[str, Tensor]) -> None:
        """Add a step's reward terms (K, N), weighted and raw, and its measures."""
        self._sums += torch.stack((terms, raw))
        if measures:
            values = torch.stack(tuple(measures.values()))
            self._measured += torch.stack((values.nan_to_num(0.0), (~values.isnan()).double()))

    def follow(self, t: Tensor, state: SimState, diverged: Tensor | None) -> None:
        """Record the object's poses at steps t (N,); diverged rows repeat the step before."""
        pos, quat = state.object_pos, state.object_quat
        if diverged is not None:
            before, keep = (self._rows, t - 1), diverged[:, None]
            pos = torch.where(keep, self._pos[before], pos)
            quat = torch.where(keep, self._quat[before], quat)
        self._pos[self._rows, t], self._quat[self._rows, t] = pos, quat

    def finished(
        self, rows: Tensor, t: Tensor, diverged: Tensor, ends: dict[str, Tensor]
    ) -> FinishedEpisodes:
        """Return the episodes of rows (k,), which ended after t (N,) steps."""
        return FinishedEpisodes(
            reference=self._reference,
            recipe=self._recipe,
            episodes=Episodes(self._pos[rows], self._quat[rows], t[rows]),
            sums=self._sums[:, :, rows],
            measured=self._measured[:, :, rows],
            flags=torch.stack((diverged, *ends.values()))[:, rows],
        )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the metrics of running episodes depend on."""
        state = {"term_sums": self._sums, "pos": self._pos, "quat": self._quat}
        state |= {"measured": self._measured} if self._recipe.measures else {}
        return {name: value.cpu().clone() for name, value in state.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self._sums.copy_(state["term_sums"])
        self._pos.copy_(state["pos"])
        self._quat.copy_(state["quat"])
        if self._recipe.measures:
            self._measured.copy_(state["measured"])
