"""The MDP over a batch of simulations: what the learner steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgdm.envs.divergence import History
from pgdm.envs.finished import Finished
from pgdm.errors import ConfigError, RunError, UnknownNameError
from pgdm.mdp.actions import ActionMap
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import Episodes
from pgdm.mdp.observations import Observe
from pgdm.mdp.recipe import Recipe
from pgdm.motion.reference import ExpertReference, ObjectReference
from pgdm.pregrasp.rollout import to_targets
from pgdm.pregrasp.sources import StartState, no_plan
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
    expert: ExpertReference | None = None


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
        self._names = [term.name for term in mdp.recipe.rewards]
        self._weights = torch.tensor(
            [[term.weight] for term in mdp.recipe.rewards], dtype=torch.float64
        )
        n, horizon = self.num_envs, len(mdp.reference)
        self._t = torch.zeros(n, dtype=torch.int64)
        # Of each reward term, (2, K, N): weighted, then raw, summed over the episode.
        self._term_sums = torch.zeros(2, len(self._names), n, dtype=torch.float64)
        # Of each measure, (2, M, N): its sum over the steps in which it applies, and their number.
        self._measured = torch.zeros(2, len(mdp.recipe.measures), n, dtype=torch.float64)
        self._pos = torch.zeros(n, horizon, 3, dtype=torch.float64)
        self._quat = torch.zeros(n, horizon, 4, dtype=torch.float64)
        self._all = np.arange(n)
        self._rows = torch.arange(n)
        self._start = self._read_start()
        self._obs = self.reset()
        self.obs_dim = self._obs.shape[1]
        mdp.recipe.check(self._context(sim.read()))

    @property
    def t(self) -> Tensor:
        """Steps since reset, (N,) int64."""
        return self._t

    def reset(self, ids: np.ndarray | None = None) -> Tensor:
        """Restart simulations ids (k,), or all; return the observations of all, (N, D) float32."""
        ids = self._all if ids is None else ids
        rows = self._restart(ids, self.mdp.start.qpos, self.mdp.start.qvel)
        obs, self._pos[rows, 0], self._quat[rows, 0] = self._start
        if len(ids) == self.num_envs:
            self._obs = obs.repeat(self.num_envs, 1)
        else:
            self._obs = self._obs.clone()
            self._obs[rows] = obs
        return self._obs

    def reach(self) -> Tensor:
        """Restart all at the hand's reset pose, carry out the plan; return (N, D) where it ends.

        Raises:
            ConfigError: if no plan leads to the start.
            RunError: if a simulation diverges on the way.
        """
        start, scene = self.mdp.start, self.sim.scene
        if start.reach is None:
            raise ConfigError(no_plan(start.source, scene))
        self._restart(self._all, start.reach.qpos, np.zeros_like(start.qvel))
        for ctrl in to_targets(scene.index, start.reach.actions):
            if self.sim.step(np.tile(ctrl, (self.num_envs, 1))).any():
                raise RunError(f"the reach of task '{scene.task.id}' diverged")
        state = self.sim.read()
        self._pos[:, 0], self._quat[:, 0] = state.object_pos, state.object_quat
        self._obs = self.mdp.observe(state, self._t)
        return self._obs

    def step(self, action: Tensor) -> StepResult:
        """Take one control step with actions (N, A) in [-1, 1], clipped to it.

        Returns:
            obs (N, D) float32, of restarted rows those after the restart; reward (N,) float32;
            terminated (N,) bool, the object was lost or the motion ended; truncated (N,) bool,
            the simulation diverged; info with ``final_obs`` (N, D), ``qpos`` (N, nq),
            ``object_error_m`` (N,), ``success`` (N,) bool, ``terms`` {name: (N,)} weighted
            rewards, ``raw_terms`` before weighting, ``discount`` (N,) that the future counts less
            in a shaped training or None, ``measures`` {name: (N,)}, NaN where they do
            not apply, ``ends`` {name: (N,) bool} and ``episodes``, the `Finished` episodes, or
            None.
        """
        if not self._auto_reset and bool((self._t >= len(self.mdp.reference) - 1).any()):
            raise RunError("the motion is over in at least one simulation; reset it before step()")
        ctrl = self.mdp.actions.act(action, self._t).numpy()
        self._history.record(ctrl)
        diverged = torch.from_numpy(self.sim.step(ctrl))
        state = self.sim.read()
        # A sum is finite only if all its parts are, and costs a tenth of looking at each.
        sums = state.qpos.sum(1) + state.object_vel.sum(1)
        if not math.isfinite(float(sums.sum())):
            diverged |= ~torch.isfinite(sums)
        some_diverged = bool(diverged.any())
        self._t = self._t + 1
        context = self._context(state)
        raw = torch.stack([term.value(context) for term in self.mdp.recipe.rewards])  # (K, N)
        measures = {m.name: m.value(context) for m in self.mdp.recipe.measures}
        ends = {end.name: end.reached(context) for end in self.mdp.recipe.ends}
        discount = None if (rule := self.mdp.recipe.discount) is None else rule(context)
        final = self.mdp.observe(state, self._t)
        if some_diverged:
            raw = raw.masked_fill(diverged, 0.0)
            measures = {k: v.masked_fill(diverged, torch.nan) for k, v in measures.items()}
            ends = {name: reached & ~diverged for name, reached in ends.items()}
            discount = None if discount is None else discount.masked_fill(diverged, 1.0)
            final[diverged] = self._obs[diverged]
            rows = diverged.nonzero()[:, 0]
            self._history.dump(rows.tolist(), self._t[rows].tolist())
        terms = self._weights * raw
        reward = terms.sum(0)
        terminated = torch.stack(tuple(ends.values())).any(0)
        self._remember(terms, raw, measures)
        self._pos[self._rows, self._t], self._quat[self._rows, self._t] = self._poses(
            state, diverged if some_diverged else None
        )
        done = terminated | diverged
        finished = done.nonzero()[:, 0]
        info: dict[str, Any] = {
            "final_obs": final,
            "qpos": state.qpos,
            "object_error_m": context.object_error,
            "success": context.object_error <= self.mdp.recipe.metrics.success_threshold_m,
            "terms": dict(zip(self._names, terms.unbind(), strict=True)),
            "raw_terms": dict(zip(self._names, raw.unbind(), strict=True)),
            "discount": None if discount is None else discount.float(),
            "measures": measures,
            "ends": ends,
            "episodes": self._finished(finished, diverged, ends) if len(finished) else None,
        }
        self._obs = final
        if self._auto_reset and len(finished):
            self.reset(finished.numpy())
        return self._obs, reward.float(), terminated, diverged, info

    def set_weights(self, weights: dict[str, float]) -> None:
        """Change reward weights by term name; schedules do this between iterations.

        Raises:
            UnknownNameError: if there is no such term.
        """
        for name, weight in weights.items():
            if name not in self._names:
                raise UnknownNameError("reward term", name, self._names)
            self._weights[self._names.index(name)] = weight

    def reward_weights(self) -> dict[str, float]:
        """Return the weight of each reward term now."""
        return dict(zip(self._names, self._weights[:, 0].tolist(), strict=True))

    def object_error(self) -> Tensor:
        """Return the object's current distance from its target, (N,) m."""
        return self._context(self.sim.read()).object_error

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
            "term_sums": self._term_sums.clone(),
            "pos": self._pos.clone(),
            "quat": self._quat.clone(),
            "weights": self._weights.clone(),
        }
        if self.mdp.recipe.measures:
            state["measured"] = self._measured.clone()
        if self._randomize is not None:
            state["randomize"] = self._randomize.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, to the bit."""
        if self._randomize is not None:
            self._randomize.load_state_dict(state["randomize"], self.sim)
        self.sim.restore(state["rows"].numpy())
        self._t, self._obs = state["t"].clone(), state["obs"].clone()
        self._term_sums = state["term_sums"].clone()
        self._pos, self._quat = state["pos"].clone(), state["quat"].clone()
        self._weights = state["weights"].clone()
        if self.mdp.recipe.measures:
            self._measured = state["measured"].clone()

    def _restart(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> Tensor:
        """Put simulations ids (k,) into a state with nothing counted yet; return their rows."""
        if self._randomize is not None:
            self._randomize.apply(self.sim, ids)
        self.sim.reset(ids, qpos, qvel)
        rows = torch.from_numpy(ids)
        self._t[rows] = 0
        self._term_sums[:, :, rows] = 0.0
        self._measured[:, :, rows] = 0.0
        return rows

    def _read_start(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the observation (D,) and the object's position (3,) and quaternion (4,) at reset.

        They are the same after every reset: what a ``Randomizer`` varies shows in contacts only.
        """
        one = self._all[:1]
        self.sim.reset(one, self.mdp.start.qpos, self.mdp.start.qvel)
        state = self.sim.read(one)
        return self.mdp.observe(state, self._t[:1])[0], state.object_pos[0], state.object_quat[0]

    def _context(self, state: SimState) -> StepContext:
        reference = self.mdp.reference
        return StepContext(
            state=state,
            t=self._t,
            last_t=len(reference) - 1,
            target_pos=reference.pos[self._t],
            target_quat=reference.quat[self._t],
            start_height=self._pos[:, 0, 2],
            index=self.sim.scene.index,
            expert=self.mdp.expert,
        )

    def _remember(self, terms: Tensor, raw: Tensor, measures: dict[str, Tensor]) -> None:
        """Add a step's terms (K, N), weighted and raw, and its measures to the episodes' sums."""
        self._term_sums += torch.stack((terms, raw))
        if measures:
            values = torch.stack(tuple(measures.values()))
            self._measured += torch.stack((values.nan_to_num(0.0), (~values.isnan()).double()))

    def _poses(self, state: SimState, diverged: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the object's pose, of a diverged simulation its last sane one."""
        if diverged is None:
            return state.object_pos, state.object_quat
        last, keep = self._t - 1, diverged[:, None]
        return (
            torch.where(keep, self._pos[self._rows, last], state.object_pos),
            torch.where(keep, self._quat[self._rows, last], state.object_quat),
        )

    def _finished(self, rows: Tensor, diverged: Tensor, ends: dict[str, Tensor]) -> Finished:
        """Return the episodes that finished in ``rows`` (k,)."""
        return Finished(
            reference=self.mdp.reference,
            recipe=self.mdp.recipe,
            episodes=Episodes(self._pos[rows], self._quat[rows], self._t[rows]),
            sums=self._term_sums[:, :, rows],
            measured=self._measured[:, :, rows],
            flags=torch.stack((diverged, *ends.values()))[:, rows],
        )
