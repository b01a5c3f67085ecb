"""The MDP over a batch of simulations, which learners step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgdm.envs.divergence import History
from pgdm.envs.episodes import RunningEpisodes
from pgdm.errors import ConfigError, RunError, check_name
from pgdm.mdp.actions import ActionMap
from pgdm.mdp.context import StepContext, on_object
from pgdm.mdp.observations import Observe
from pgdm.mdp.recipe import Recipe
from pgdm.motion.reference import ExpertReference, ObjectReference
from pgdm.pregrasp.reach.rollout import to_targets
from pgdm.pregrasp.sources import StartState, no_plan
from pgdm.sim.batch import Array, SimState, Simulations
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

    All tensors are on the device of the simulations. Poses are in the world frame; units m, rad, s.

    Args:
        sim: the simulations.
        mdp: observations, actions, rewards, terminations, metrics, on the device of ``sim``.
        randomize: randomises the object at every reset, or None.
        auto_reset: whether rows restart automatically when their episode ends; if not, the caller
            must reset them before the next step.
        dump_dir: folder for the last states and actuator targets of simulations that diverge, or
            None.
    """

    def __init__(
        self,
        sim: Simulations,
        mdp: Mdp,
        randomize: Randomizer | None = None,
        auto_reset: bool = True,
        dump_dir: Path | None = None,
    ) -> None:
        self.sim, self.mdp = sim, mdp
        self.num_envs, self.device = sim.num_envs, sim.device
        self.action_dim = sim.scene.index.num_actuators
        self._randomize, self._auto_reset = randomize, auto_reset
        self._history = History(sim, dump_dir)
        self._names = [term.name for term in mdp.recipe.rewards]
        self._weights = torch.tensor(
            [[term.weight] for term in mdp.recipe.rewards],
            dtype=torch.float64,
            device=self.device,
        )
        n = self.num_envs
        self._t = torch.zeros(n, dtype=torch.int64, device=self.device)
        self._episodes = RunningEpisodes(n, mdp.reference, mdp.recipe)
        self._all = torch.arange(n, device=self.device)
        self._start = self._read_start()
        self._obs = self.reset()
        self.obs_dim = self._obs.shape[1]
        mdp.recipe.check(self._context(sim.read()))

    @property
    def t(self) -> Tensor:
        """Steps since reset, (N,) int64."""
        return self._t

    def reset(self, ids: Array | None = None) -> Tensor:
        """Restart simulations ids (k,), or all; return the observations of all, (N, D) float32."""
        rows = self._all if ids is None else torch.as_tensor(ids, device=self.device)
        self._restart(rows, self.mdp.start.qpos, self.mdp.start.qvel)
        obs, pos, quat, _ = self._start
        self._episodes.place(rows, pos, quat)
        if len(rows) == self.num_envs:
            self._obs = obs.repeat(self.num_envs, 1)
        else:
            self._obs = self._obs.clone()
            self._obs[rows] = obs
        return self._obs

    def reach(self) -> Tensor:
        """Restart all at the reset pose and carry out the reach; return the final obs (N, D).

        Raises:
            ConfigError: if no plan leads to the start state.
            RunError: if a simulation diverges.
        """
        start, scene = self.mdp.start, self.sim.scene
        if start.reach is None:
            raise ConfigError(no_plan(start.source, scene))
        self._restart(self._all, start.reach.qpos, np.zeros_like(start.qvel))
        for ctrl in to_targets(scene.index, start.reach.actions):
            if self.sim.step(np.tile(ctrl, (self.num_envs, 1))).any():
                raise RunError(f"the reach of task '{scene.task.id}' diverged")
        state = self.sim.read()
        self._episodes.place(self._all, state.object_pos, state.object_quat)
        self._obs = self.mdp.observe(state, self._t)
        return self._obs

    def step(self, action: Tensor) -> StepResult:
        """Take one control step with actions (N, A), which are clipped to [-1, 1].

        Returns:
            obs (N, D) float32, for restarted rows the first after the restart; reward (N,) float32;
            terminated (N,) bool, the object was lost or the motion ended; truncated (N,) bool,
            the simulation diverged; info with ``final_obs`` (N, D), before any restart; ``qpos``
            (N, nq); ``object_error_m`` (N,); ``success`` (N,) bool; ``terms`` {name: (N,)} weighted
            rewards; ``raw_terms`` unweighted; ``discount`` (N,), the extra discount of shaping, or
            None; ``measures`` {name: (N,)}, NaN where they do not apply; ``ends``
            {name: (N,) bool}, terminations; and ``episodes``, the `FinishedEpisodes`, or None.
            Diverged rows have reward 0 and, as ``final_obs``, their previous observation.

        Raises:
            ConfigError: if the actions are not numeric or have the wrong shape.
            RunError: without ``auto_reset``, if the motion is over in a simulation.
        """
        state, diverged = self._advance(self._checked(action))
        some_diverged = bool(diverged.any())
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
        self._episodes.add(terms, raw, measures)
        self._episodes.follow(self._t, state, diverged if some_diverged else None)
        finished = (terminated | diverged).nonzero()[:, 0]
        episodes = None
        if len(finished):
            episodes = self._episodes.finished(finished, self._t, diverged, ends)
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
            "episodes": episodes,
        }
        self._obs = final
        if self._auto_reset and len(finished):
            self.reset(finished)
        return self._obs, reward.float(), terminated, diverged, info

    def _checked(self, action: Tensor) -> Tensor:
        try:
            action = torch.as_tensor(action)  # accepts NumPy arrays too
        except (TypeError, ValueError, RuntimeError) as error:
            raise ConfigError(f"the actions are not an array of numbers: {error}") from error
        if action.shape != (self.num_envs, self.action_dim):
            raise ConfigError(
                f"the actions have shape {tuple(action.shape)}; it must be (num_envs, action_dim), "
                f"{(self.num_envs, self.action_dim)}"
            )
        return action

    def set_weights(self, weights: dict[str, float]) -> None:
        """Change reward weights by term name; schedules do this between iterations.

        Raises:
            UnknownNameError: if there is no such term.
        """
        for name, weight in weights.items():
            check_name("reward term", name, self._names)
            self._weights[self._names.index(name)] = weight

    def reward_weights(self) -> dict[str, float]:
        """Return the current weight of each reward term."""
        return dict(zip(self._names, self._weights[:, 0].tolist(), strict=True))

    def object_error(self) -> Tensor:
        """Return the current object error, (N,) m."""
        return self._context(self.sim.read()).object_error

    def reseed(self, seed: int) -> None:
        """Reseed the randomisation at resets, if the task has it."""
        if self._randomize is not None:
            self._randomize.reseed(seed)

    def warm_start(self) -> Tensor:
        """Return the action (A,) at which a policy's mean starts; see `ActionMap`."""
        return self.mdp.actions.warm_start.float()

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on."""
        state: dict[str, Any] = {
            "rows": torch.as_tensor(self.sim.rows).cpu().clone(),
            "t": self._t.cpu().clone(),
            "obs": self._obs.cpu().clone(),
            "weights": self._weights.cpu().clone(),
            **self._episodes.state_dict(),
        }
        if self._randomize is not None:
            state["randomize"] = self._randomize.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit-exactly."""
        if self._randomize is not None:
            self._randomize.load_state_dict(state["randomize"], self.sim)
        self.sim.restore(state["rows"].numpy())
        self._t = state["t"].to(self.device, copy=True)
        self._obs = state["obs"].to(self.device, copy=True)
        self._weights = state["weights"].to(self.device, copy=True)
        self._episodes.load_state_dict(state)

    def _advance(self, action: Tensor) -> tuple[SimState, Tensor]:
        """Step all simulations; return their state and which of them diverged, (N,) bool."""
        if not self._auto_reset and bool((self._t >= len(self.mdp.reference) - 1).any()):
            raise RunError("the motion is over in at least one simulation; reset it before step()")
        ctrl = self.mdp.actions.act(action.to(self.device), self._t)
        self._history.record(ctrl)
        diverged = torch.as_tensor(self.sim.step(ctrl))
        state = self.sim.read()
        # A sum is finite only if all its terms are; it is ten times cheaper than checking each.
        sums = state.qpos.sum(1) + state.object_vel.sum(1)
        if not math.isfinite(float(sums.sum())):
            diverged |= ~torch.isfinite(sums)
        self._t = self._t + 1
        return state, diverged

    def _restart(self, rows: Tensor, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put simulations rows (k,) into a state and clear their episode sums."""
        if self._randomize is not None:
            self._randomize.apply(self.sim, rows)
        self.sim.reset(rows, qpos, qvel)
        self._t[rows] = 0
        self._episodes.restart(rows)

    def _read_start(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return observation (D,), object position (3,) and quaternion (4,), fingertips (F, 3).

        They are the same after every reset, as a ``Randomizer`` does not change poses. The
        fingertips are in the object's frame.
        """
        one = self._all[:1]
        self.sim.reset(one, self.mdp.start.qpos, self.mdp.start.qvel)
        state = self.sim.read(one)
        obs, tips = self.mdp.observe(state, self._t[:1]), on_object(state, self.sim.scene.index)
        return obs[0], state.object_pos[0], state.object_quat[0], tips[0]

    def _context(self, state: SimState) -> StepContext:
        reference = self.mdp.reference
        return StepContext(
            state=state,
            t=self._t,
            last_t=len(reference) - 1,
            target_pos=reference.pos[self._t],
            target_quat=reference.quat[self._t],
            start_height=self._episodes.start_height,
            pregrasp_fingertips=self._start[3],
            index=self.sim.scene.index,
            expert=self.mdp.expert,
        )
