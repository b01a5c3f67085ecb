"""Building batch envs from settings and library."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgdm.envs.batch_env import BatchEnv, Mdp
from pgdm.errors import check_count, check_name
from pgdm.library import Expert, Library
from pgdm.library.published_masses import RATIOS
from pgdm.mdp.actions import ActionCfg, action_map, warm_targets
from pgdm.mdp.observations import ObsCfg, layout
from pgdm.mdp.recipe import Recipe
from pgdm.mdp.shaping import ShapingCfg, shaped
from pgdm.memory import check_fits
from pgdm.motion.reference import FRAMES, ExpertReference, ObjectReference, ReferenceCfg
from pgdm.pregrasp.ablation.ablate import AblationCfg, ablate
from pgdm.pregrasp.sources import PregraspCfg, start_state
from pgdm.sim.batch import SimBatch
from pgdm.sim.randomize import Randomizer
from pgdm.sim.scene import WARP, HandCfg, Scene, SimCfg, TaskCfg, build_scene
from pgdm.wrist.plan import WristPlan, WristProblem, shortcoming

TRAIN = "train"
"""Random stream of the simulations that a policy is trained in."""

_AWAY_M = 0.1
"""A larger distance between object and first target at the start is reported."""
_FAR_M = 0.01
"""An expert's hand that is clipped by more than this is reported."""


@dataclass(frozen=True)
class EnvCfg:
    """Settings of an environment."""

    task: TaskCfg
    hand: HandCfg
    sim: SimCfg
    pregrasp: PregraspCfg
    ablation: AblationCfg
    obs: ObsCfg
    action: ActionCfg
    reference: ReferenceCfg
    shaping: ShapingCfg | None = None
    """What training adds to reward and discount; None: nothing."""


class EnvBuilder:
    """Compiles a task once and builds batches of it.

    Args:
        library: library with the task's assets.
        cfg: settings of the environment.
        recipe: recipe of the method.
        plan: called for the wrist plan if the action uses one. If it returns None, because the plan
            is not computed yet, the base follows the clipped path (`pgdm.wrist.path`).

    Raises:
        PgdmError: if the library lacks an asset, the scene does not compile, the start state is
            not stored, or the recipe needs an expert that the task does not have.
    """

    def __init__(
        self,
        library: Library,
        cfg: EnvCfg,
        recipe: Recipe,
        plan: Callable[[WristProblem], WristPlan | None],
    ) -> None:
        self.scene: Scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
        self.motion = library.motion(cfg.task.motion)
        self._cfg = cfg
        start = start_state(cfg.pregrasp, self.motion, self.scene)
        self.ablated = None
        if cfg.ablation.changes_start:
            self.ablated = ablate(cfg.ablation, start, self.scene, self.motion.substeps)
            start = self.ablated.start
        index = self.scene.index
        reference = _reference(cfg.reference, ObjectReference.of(self.motion), self.scene)
        self.expert = library.expert(cfg.task.motion) if recipe.needs_expert else None
        qpos = torch.from_numpy(start.qpos)
        self.wrist_problem = WristProblem(
            self.scene,
            reference,
            start.qpos,
            start.qvel,
            warm_targets(index, qpos).numpy(),
            self.motion.substeps,
            cfg.action.hold_steps,
            cfg.action.carry_load,
        )
        action, self.wrist = cfg.action, None
        if action.plans_wrist:
            self.wrist = plan(self.wrist_problem)
            action = action if self.wrist else replace(action, wrist_path="clipped")
        commands = None if self.wrist is None else torch.from_numpy(self.wrist.commands)
        self.mdp = Mdp(
            reference=reference,
            start=start,
            observe=layout(cfg.obs, index, reference),
            actions=action_map(action, index, reference, qpos, commands),
            recipe=recipe,
            expert=None if self.expert is None else _followed(self.expert, self.scene),
        )

    @property
    def notes(self) -> list[str]:
        """Sentences on deviations from the settings, and on peculiarities of the task."""
        task, used = self.scene.task.id, self.mdp.start.source
        notes = []
        if self._cfg.sim.engine == WARP:
            notes.append(
                "training in MuJoCo Warp: the first run of a scene compiles its kernels, which "
                "takes one to three minutes; evaluations run in C MuJoCo"
            )
        if used != (wanted := self._cfg.pregrasp.source):
            notes.append(
                f"the {self.scene.asset_source} assets have no '{wanted}' start of {task}; "
                f"starting from '{used}' ('pgdm pregrasp reach {task}' plans one)"
            )
        if (note := self._away_from_target()) is not None:
            notes.append(note)
        if self.wrist is not None and (note := shortcoming(self.wrist_problem, self.wrist)):
            notes.append(note)
        unknown = ", ".join(name for name in self.scene.task.objects if name not in RATIOS)
        if unknown and self._cfg.sim.object_mass == "published":
            notes.append(
                f"sim.object_mass=published: the published mass of {unknown} is not known; "
                "keeping the mass by volume"
            )
        if self.ablated is not None:
            ablation = self._cfg.ablation
            if deviation := self.ablated.compromises(ablation.distance_m):
                notes.append(f"ablation={ablation.name} of {task}: {deviation}")
        if self.expert is not None and self.expert.approximate:
            notes.append(
                f"the expert hand trajectory of {task} is approximate: the published one is empty, "
                "so it was rebuilt from another recording"
            )
        if (beyond := self._expert_beyond_m()) > _FAR_M:
            notes.append(
                f"the expert's hand of {task} leaves the robot's limits by up to {beyond:.2f} m; "
                "it is clipped to the limits, so methods follow a hand that is off by this much"
            )
        return notes

    def _away_from_target(self) -> str | None:
        """Return a sentence with both points if the object starts far from its first target."""
        sim = SimBatch(self.scene, 1, 1, self.motion.substeps)
        sim.reset(np.array([0]), self.mdp.start.qpos, self.mdp.start.qvel)
        start, target = sim.read().object_pos[0], self.mdp.reference.pos[0]
        away = float(torch.linalg.vector_norm(start - target))
        if away <= _AWAY_M:
            return None
        return (
            f"the object of {self.scene.task.id} starts {100 * away:.0f} cm from its first target: "
            f"its centre of mass is at ({_point(start)}) m, the target at ({_point(target)}) m"
        )

    def _expert_beyond_m(self) -> float:
        """Return the largest distance by which the expert's base slides leave their ranges, m."""
        if self.expert is None or self.mdp.expert is None:
            return 0.0
        return float(np.abs(self.expert.qpos - self.mdp.expert.joints.numpy())[:, :3].max())

    def facts(self) -> dict[str, str]:
        """Return what a result depends on besides settings and code: sources and hashes."""
        facts = {
            "asset_source": self.scene.asset_source,
            "motion_sha256": self.motion.sha256,
            "scene_sha256": self.scene.digest(),
            "pregrasp_used": self.mdp.start.source,
        }
        if self.wrist is not None:
            facts["wrist_sha256"] = self.wrist.sha256()
        if self.mdp.start.sha256:
            facts["pregrasp_sha256"] = self.mdp.start.sha256
        if self.ablated is not None:
            facts |= self.ablated.facts()
        if self.expert is not None:
            facts["expert_sha256"] = self.expert.sha256
            facts["expert_hand"] = (
                "rebuilt, approximate" if self.expert.approximate else "published"
            )
        return facts

    def differences(self, recorded: Mapping[str, Any]) -> Iterator[str]:
        """Yield a text for each of the `facts` that a run lacks or recorded with another value."""
        for key, now in self.facts().items():
            if recorded.get(key) != now:
                text = f"{key} '{recorded.get(key)}', and the library now has '{now}'"
                yield text + (self._recentred() if key == "scene_sha256" else "")

    def _recentred(self) -> str:
        """Return why an older run's scene differs if the tracked body is massless; else empty."""
        if self.scene.model.body_mass[self.scene.index.object_body] > 0:
            return ""
        return (
            f" (the tracked body {self.scene.task.tracked_body} is massless: its centre of mass is "
            "now its origin, but was another point in earlier versions)"
        )

    def make(
        self,
        num_envs: int,
        num_threads: int = 0,
        seed: int = 0,
        stream: str = TRAIN,
        auto_reset: bool = True,
        dump_dir: Path | None = None,
        device: str = "cpu",
    ) -> BatchEnv:
        """Return N simulations of the task.

        ``num_threads`` is as in `SimBatch`, ``auto_reset`` and ``dump_dir`` as in `BatchEnv`;
        ``seed`` is the seed of the randomisation at resets, if the task has it. ``stream`` names
        the random stream and thereby the use of the simulations. Only ``train`` has the shaping and
        the configured engine, on ``device``; the simulations of all other streams run in C MuJoCo.

        Raises:
            ConfigError: if ``num_envs`` is below 1 or ``num_threads`` below 0, the simulations do
                not fit into the memory, or the engine is not installed or cannot use the device.
        """
        check_count("num_envs", num_envs, 1)
        check_count("num_threads", num_threads, 0)
        mdp, shaping = self.mdp, self._cfg.shaping
        if shaping is not None and stream == TRAIN:
            error_m = None if self.wrist is None else torch.from_numpy(self.wrist.error_m)
            mdp = replace(mdp, recipe=shaped(mdp.recipe, shaping, error_m))
        if stream == TRAIN and self._cfg.sim.engine == WARP:
            from pgdm.sim.warp import WarpBatch  # an optional dependency

            sim = WarpBatch(self.scene, num_envs, self.motion.substeps, device)
            mdp = self._on(sim.device, mdp)
        else:
            if num_envs > 1:
                self.check_memory("num_envs" if stream == TRAIN else "eval.episodes", num_envs)
            sim = SimBatch(self.scene, num_envs, num_threads, self.motion.substeps)
        randomize = Randomizer(seed, stream, num_envs) if self.scene.task.randomize else None
        return BatchEnv(sim, mdp, randomize, auto_reset, dump_dir)

    def _on(self, device: torch.device, mdp: Mdp) -> Mdp:
        """Return an MDP whose tensors are on a device."""
        mdp = replace(
            mdp,
            reference=_moved(mdp.reference, device),
            actions=_moved(mdp.actions, device),
            expert=_moved(mdp.expert, device),
        )
        return replace(mdp, observe=layout(self._cfg.obs, self.scene.index, mdp.reference))

    @cached_property
    def probe(self) -> BatchEnv:
        """An env with one simulation, to read sizes from."""
        return self.make(1, 1, stream=TRAIN if self._cfg.sim.engine != WARP else "probe")

    def check_memory(self, key: str, num_envs: int, others_bytes: float = 0.0) -> None:
        """Check that ``num_envs`` simulations and ``others_bytes`` fit into the free memory.

        Training simulations in MuJoCo Warp count as 0: they are in the device's memory.

        Raises:
            ConfigError: if they do not fit; the message names ``key``, the setting to reduce.
        """
        on_device = key == "num_envs" and self._cfg.sim.engine == WARP
        each = 0 if on_device else self.probe.sim.bytes_each
        needed = num_envs * each + others_bytes
        check_fits(f"{key}={num_envs}", needed, f"use a smaller {key}")


def _moved(value: Any, device: torch.device) -> Any:
    """Return a tensor, or a dataclass with all its tensors, on a device; other values unchanged."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{f.name: _moved(getattr(value, f.name), device) for f in fields(value)})


def _point(pos: torch.Tensor) -> str:
    return ", ".join(f"{x:.3f}" for x in pos.tolist())


def _reference(cfg: ReferenceCfg, stored: ObjectReference, scene: Scene) -> ObjectReference:
    check_name("reference frame", cfg.frame, FRAMES)
    if cfg.frame == "released":
        return stored
    com = scene.model.body_ipos[scene.index.object_body].copy()
    return stored.com_corrected(torch.from_numpy(com))


def _followed(expert: Expert, scene: Scene) -> ExpertReference:
    model, n = scene.model, scene.index.num_joints
    low, high = torch.from_numpy(model.jnt_range[:n].copy()).unbind(1)
    com = torch.from_numpy(model.body_ipos[scene.index.object_body].copy())
    return ExpertReference.of(expert, low, high, com)
