"""Episodes that have ended, and what they measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.mdp.metrics import Episodes, episode_metrics
from pgdm.mdp.recipe import Recipe
from pgdm.motion.reference import ObjectReference


@dataclass(frozen=True)
class Finished:
    """k finished episodes of one task.

    The metrics are computed when asked for: once for many episodes costs what it does for one.
    """

    reference: ObjectReference
    recipe: Recipe
    episodes: Episodes
    sums: Tensor  # (2, K, k) of each reward term over the episode: weighted, then raw
    measured: Tensor  # (2, M, k) of each measure: sum over the steps it applies to, their number
    flags: Tensor  # (1 + E, k) bool: diverged, then each of the recipe's ends

    def metrics(self) -> dict[str, Tensor]:
        """Return each metric's values, (k,) float64; see `pgdm.mdp.metrics.episode_metrics`.

        Beside those: ``return``, the sum of the task's own rewards, and ``shaping``, of those that
        a training adds, if it does; ``diverged``, ``end/<name>``, the mean of each measure under
        its name, NaN where it never applied, and of each reward term the sum over the episode,
        ``term/<name>`` weighted and ``raw/<name>`` before.
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

    def with_later(self, later: Sequence[Finished]) -> Finished:
        """Return these episodes and others of the same task as one, in this order."""
        every = (self, *later)
        return Finished(
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
