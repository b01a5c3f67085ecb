"""The MDP over a batch of simulations: what the learner steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgdm.envs.divergence import History
from pgdm.errors import RunError, UnknownNameError
from pgdm.mdp.actions import ActionMap
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import Episodes, episode_metrics
from pgdm.mdp.observations import Observe
from pgdm.mdp.recipe import Recipe
from pgdm.mdp.rewards import object_error
from pgdm.motion.reference import ObjectReference
from pgdm.pregrasp.sources import StartState
from pgdm.sim.batch import SimBatch, SimState
from pgdm.sim.randomize import Randomizer

StepResult = tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]


@dataclass(frozen=True)
class Mdp:
    """The parts of one task's MDP."""

    reference: ObjectReference
    start: StartState
    observe: Observe
    actions: ActionMap
    recipe: Recipe


class BatchEnv:
    """N copies of one task, stepped together.

    All tensors are on the CPU. Frames are the world's; units are m, rad, s.

    Args:
        sim: the simulations.
        mdp: observations, actions, rewards, ends, metrics.
        randomize: per-reset variation of a simulation's contact, or None.
        auto_reset: whether finished rows restart by themselves; if not, stepping them further is
            an error of the caller.
        dump_dir: folder for the last states and actions of simulations that diverge, or None.
    """

    def __init__(
        self,
        sim: SimBatch,
        mdp: Mdp,
        randomize: Randomizer | None = None,
        auto_reset: bool = True,
        dump_dir: Path | None = None,
    ) -> None:
        self.sim, self.mdp = sim, mdp
        self.num_envs = sim.num_envs
        self.action_dim = sim.scene.index.num_actuators
        self._randomize, self._auto_reset = randomize, auto_reset
        self._history = History(sim, dump_dir)
        self._weights = {term.name: term.weight for term in mdp.recipe.rewards}
        n, horizon = self.num_envs, len(mdp.reference)
        self._t = torch.zeros(n, dtype=torch.int64)
        self._return = torch.zeros(n, dtype=torch.float64)
        sums = [f"{kind}/{name}" for kind in ("term", "raw") for name in self._weights]
        self._term_sums = {name: torch.zeros(n, dtype=torch.float64) for name in sums}
        self._pos = torch.zeros(n, horizon, 3, dtype=torch.float64)
        self._quat = torch.zeros(n, horizon, 4, dtype=torch.float64)
        self._all = np.arange(n)
        self._rows = torch.arange(n)
        self._obs = self.reset()
        self.obs_dim = self._obs.shape[1]

    @property
    def t(self) -> Tensor:
        """Steps since reset, (N,) int64."""
        return self._t

    def reset(self, ids: np.ndarray | None = None) -> Tensor:
        """Restart simulations ids (k,), or all; return the observations of all, (N, D) float32."""
        ids = self._all if ids is None else ids
        if self._randomize is not None:
            self._randomize.apply(self.sim, ids)
        self.sim.reset(ids, self.mdp.start.qpos, self.mdp.start.qvel)
        rows = torch.from_numpy(ids)
        state = self.sim.read(ids)
        self._t[rows] = 0
        self._return[rows] = 0.0
        for total in self._term_sums.values():
            total[rows] = 0.0
        self._pos[rows, 0], self._quat[rows, 0] = state.object_pos, state.object_quat
        fresh = self.mdp.observe(state, self._t[rows])
        if len(ids) == self.num_envs:
            self._obs = fresh
        else:
            self._obs = self._obs.clone()
            self._obs[rows] = fresh
        return self._obs

    def step(self, action: Tensor) -> StepResult:
        """Take one control step with actions (N, A) in [-1, 1], clipped to it.

        Returns:
            obs (N, D) float32, of restarted rows those after the restart; reward (N,) float32;
            terminated (N,) bool, the object was lost or the motion ended; truncated (N,) bool,
            the simulation diverged; info with ``final_obs`` (N, D), ``qpos`` (N, nq),
            ``object_error_m`` (N,), ``success`` (N,) bool, ``terms`` {name: (N,)} weighted
            rewards, ``raw_terms`` before weighting, ``ends`` {name: (N,) bool} and ``episodes``
            {metric: (k,)} of the k episodes that finished.
        """
        if not self._auto_reset and bool((self._t >= len(self.mdp.reference) - 1).any()):
            raise RunError("the motion is over in at least one simulation; reset it before step()")
        ctrl = self.mdp.actions.act(action, self._t).numpy()
        self._history.record(ctrl)
        diverged = torch.from_numpy(self.sim.step(ctrl))
        state = self.sim.read()
        diverged |= ~torch.isfinite(state.qpos).all(1) | ~torch.isfinite(state.object_vel).all(1)
        self._t = self._t + 1
        context = self._context(state)
        raw = {term.name: term.value(context) for term in self.mdp.recipe.rewards}
        terms = {name: self._weights[name] * value for name, value in raw.items()}
        ends = {end.name: end.reached(context) & ~diverged for end in self.mdp.recipe.ends}
        terminated = torch.stack(tuple(ends.values())).any(0)
        error = object_error(context)
        if diverged.any():
            terms = {name: value.masked_fill(diverged, 0.0) for name, value in terms.items()}
            raw = {name: value.masked_fill(diverged, 0.0) for name, value in raw.items()}
        reward = torch.stack(tuple(terms.values())).sum(0)
        final = self.mdp.observe(state, self._t)
        if diverged.any():
            final[diverged] = self._obs[diverged]
            rows = diverged.nonzero()[:, 0]
            self._history.dump(rows.tolist(), self._t[rows].tolist())
        self._account(state, reward, terms, raw, diverged)
        info: dict[str, Any] = {
            "final_obs": final,
            "qpos": state.qpos,
            "object_error_m": error,
            "success": error <= self.mdp.recipe.metrics.success_threshold_m,
            "terms": terms,
            "raw_terms": raw,
            "ends": ends,
        }
        done = terminated | diverged
        info["episodes"] = self._finish(done, diverged, ends)
        self._obs = final
        if self._auto_reset and done.any():
            self.reset(done.nonzero()[:, 0].numpy())
        return self._obs, reward.float(), terminated, diverged, info

    def set_weights(self, weights: dict[str, float]) -> None:
        """Change reward weights by term name; schedules do this between iterations.

        Raises:
            UnknownNameError: if there is no such term.
        """
        for name in weights:
            if name not in self._weights:
                raise UnknownNameError("reward term", name, self._weights)
        self._weights.update(weights)

    def object_error(self) -> Tensor:
        """Return the object's current distance from its target, (N,) m."""
        return object_error(self._context(self.sim.read()))

    def reseed(self, seed: int) -> None:
        """Restart the stream of the per-reset variation; tasks without one ignore it."""
        if self._randomize is not None:
            self._randomize.reseed(seed)

    def warm_start(self) -> Tensor:
        """Return the action (A,) that a policy's mean should start from (R)."""
        return self.mdp.actions.warm_start.float()

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next step depends on."""
        state: dict[str, Any] = {
            "rows": torch.from_numpy(self.sim.rows.copy()),
            "t": self._t.clone(),
            "obs": self._obs.clone(),
            "return": self._return.clone(),
            "term_sums": {name: value.clone() for name, value in self._term_sums.items()},
            "pos": self._pos.clone(),
            "quat": self._quat.clone(),
            "weights": dict(self._weights),
        }
        if self._randomize is not None:
            state["randomize"] = self._randomize.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, to the bit."""
        if self._randomize is not None:
            self._randomize.load_state_dict(state["randomize"], self.sim)
        self.sim.restore(state["rows"].numpy())
        self._t, self._obs = state["t"].clone(), state["obs"].clone()
        self._return = state["return"].clone()
        self._term_sums = {name: value.clone() for name, value in state["term_sums"].items()}
        self._pos, self._quat = state["pos"].clone(), state["quat"].clone()
        self._weights = dict(state["weights"])

    def _context(self, state: SimState) -> StepContext:
        reference = self.mdp.reference
        return StepContext(
            state=state,
            t=self._t,
            last_t=len(reference) - 1,
            target_pos=reference.pos[self._t],
            target_quat=reference.quat[self._t],
            start_height=self._pos[:, 0, 2],
        )

    def _account(
        self,
        state: SimState,
        reward: Tensor,
        terms: dict[str, Tensor],
        raw: dict[str, Tensor],
        diverged: Tensor,
    ) -> None:
        self._return += reward
        for name, value in terms.items():
            self._term_sums[f"term/{name}"] += value
            self._term_sums[f"raw/{name}"] += raw[name]
        keep = diverged[:, None]  # a diverged simulation keeps its last sane pose
        last = self._t - 1
        self._pos[self._rows, self._t] = torch.where(
            keep, self._pos[self._rows, last], state.object_pos
        )
        self._quat[self._rows, self._t] = torch.where(
            keep, self._quat[self._rows, last], state.object_quat
        )

    def _finish(self, done: Tensor, diverged: Tensor, ends: dict[str, Tensor]) -> dict[str, Tensor]:
        if not done.any():
            return {}
        episodes = Episodes(self._pos[done], self._quat[done], self._t[done])
        metrics = episode_metrics(episodes, self.mdp.reference, self.mdp.recipe.metrics)
        metrics["return"] = self._return[done].clone()
        metrics["diverged"] = diverged[done].double()
        metrics |= {f"end/{name}": flag[done].double() for name, flag in ends.items()}
        metrics |= {name: total[done] for name, total in self._term_sums.items()}
        return metrics
