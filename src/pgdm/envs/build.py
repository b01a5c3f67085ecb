"""From configuration and library to a batch env."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgdm.envs.batch_env import BatchEnv, Mdp
from pgdm.errors import UnknownNameError
from pgdm.library import Expert, Library
from pgdm.library.published_masses import RATIOS
from pgdm.mdp.actions import ActionCfg, action_map, warm_targets
from pgdm.mdp.observations import ObsCfg, layout
from pgdm.mdp.recipe import Recipe
from pgdm.mdp.shaping import ShapingCfg, shaped
from pgdm.motion.reference import FRAMES, ExpertReference, ObjectReference, ReferenceCfg
from pgdm.pregrasp.ablate import AblationCfg, ablate
from pgdm.pregrasp.sources import PregraspCfg, start_state
from pgdm.sim.batch import SimBatch
from pgdm.sim.randomize import Randomizer
from pgdm.sim.scene import HandCfg, Scene, SimCfg, TaskCfg, build_scene
from pgdm.wrist.plan import WristPlan, WristProblem

TRAIN = "train"
"""Stream of the simulations that a policy is trained in."""

_AWAY_M = 0.1
"""Further than this from its first target, an object does not start where its motion begins."""
_FAR_M = 0.01
"""Clipped by more than this, an expert's hand is not where the person's was."""


@dataclass(frozen=True)
class EnvCfg:
    """What an environment is made of."""

    task: TaskCfg
    hand: HandCfg
    sim: SimCfg
    pregrasp: PregraspCfg
    ablation: AblationCfg
    obs: ObsCfg
    action: ActionCfg
    reference: ReferenceCfg
    shaping: ShapingCfg | None = None
    """What trainings add; None: nothing."""


class EnvBuilder:
    """Compiles a task once and makes batches of it.

    Args:
        library: with the task's assets.
        cfg: what the environment is made of.
        recipe: the method's.
        plan: gives the plan of the wrist, where the action wants one.

    Raises:
        PgdmError: if the library lacks an asset, the scene does not compile, the start state is
            not stored, or the recipe needs an expert that the task does not have.
    """

    def __init__(
        self,
        library: Library,
        cfg: EnvCfg,
        recipe: Recipe,
        plan: Callable[[WristProblem], WristPlan],
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
        self.wrist = plan(self.wrist_problem) if cfg.action.plans_wrist else None
        commands = None if self.wrist is None else torch.from_numpy(self.wrist.commands)
        self.mdp = Mdp(
            reference=reference,
            start=start,
            observe=layout(cfg.obs, index, reference),
            actions=action_map(cfg.action, index, reference, qpos, commands),
            recipe=recipe,
            expert=None if self.expert is None else _followed(self.expert, self.scene),
        )

    @property
    def notes(self) -> list[str]:
        """Sentences that say what differs from what was asked for, or from other tasks."""
        task, used = self.scene.task.id, self.mdp.start.source
        notes = []
        if used != (wanted := self._cfg.pregrasp.source):
            notes.append(
                f"{task} has no start '{wanted}' in the assets of "
                f"{self.scene.asset_source}; starting from '{used}' ('pgdm pregrasp reach {task}' "
                "plans one)"
            )
        if (note := self._away_from_target()) is not None:
            notes.append(note)
        unknown = ", ".join(name for name in self.scene.task.objects if name not in RATIOS)
        if unknown and self._cfg.sim.object_mass == "published":
            notes.append(
                f"sim.object_mass=published: the published mass of {unknown} is not known; "
                "the mass by volume stays"
            )
        if self.ablated is not None:
            ablation = self._cfg.ablation
            if told := self.ablated.compromises(ablation.distance_m):
                notes.append(f"ablation={ablation.name} of {task}: {told}")
        if self.expert is not None and self.expert.approximate:
            notes.append(
                f"the expert hand trajectory of {task} is approximate: it was rebuilt from another "
                "recording, as the published one is empty"
            )
        if (beyond := self._expert_beyond_m()) > _FAR_M:
            notes.append(
                f"the expert's hand of {task} leaves the robot's limits by up to {beyond:.2f} m; "
                "methods follow it clipped to them, that far from the object"
            )
        return notes

    def _away_from_target(self) -> str | None:
        """Return a sentence if the object starts far from its first target, with both points."""
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
        """Return by how much the base of the expert's hand leaves its limits at most."""
        if self.expert is None or self.mdp.expert is None:
            return 0.0
        return float(np.abs(self.expert.qpos - self.mdp.expert.joints.numpy())[:, :3].max())

    def facts(self) -> dict[str, str]:
        """Return what a result depends on besides its configuration and the program."""
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
        """Yield what of a run's recorded facts is not so here."""
        for key, now in self.facts().items():
            if recorded.get(key) != now:
                told = f"{key} '{recorded.get(key)}', and the library now has '{now}'"
                yield told + (self._recentred() if key == "scene_sha256" else "")

    def _recentred(self) -> str:
        """Return what is to be said of an older run's scene, if its tracked body is massless."""
        if self.scene.model.body_mass[self.scene.index.object_body] > 0:
            return ""
        return (
            f" (the tracked body {self.scene.task.tracked_body} is massless: its centre of mass is "
            "now its origin, and lay elsewhere in runs of earlier versions)"
        )

    def make(
        self,
        num_envs: int,
        num_threads: int = 0,
        seed: int = 0,
        stream: str = TRAIN,
        auto_reset: bool = True,
        dump_dir: Path | None = None,
    ) -> BatchEnv:
        """Return N simulations of the task; see `BatchEnv` for the arguments.

        ``stream`` names what the simulations are for: each has random numbers of its own, and
        those for ``train`` have the shaping.
        """
        mdp, shaping = self.mdp, self._cfg.shaping
        if shaping is not None and stream == TRAIN:
            mdp = replace(mdp, recipe=shaped(mdp.recipe, shaping))
        sim = SimBatch(self.scene, num_envs, num_threads, self.motion.substeps)
        randomize = Randomizer(seed, stream, num_envs) if self.scene.task.randomize else None
        return BatchEnv(sim, mdp, randomize, auto_reset, dump_dir)


def _point(pos: torch.Tensor) -> str:
    return ", ".join(f"{x:.3f}" for x in pos.tolist())


def _reference(cfg: ReferenceCfg, stored: ObjectReference, scene: Scene) -> ObjectReference:
    if cfg.frame not in FRAMES:
        raise UnknownNameError("reference frame", cfg.frame, FRAMES)
    if cfg.frame == "released":
        return stored
    com = scene.model.body_ipos[scene.index.object_body].copy()
    return stored.com_corrected(torch.from_numpy(com))


def _followed(expert: Expert, scene: Scene) -> ExpertReference:
    model, nu = scene.model, scene.index.num_actuators
    low, high = torch.from_numpy(model.jnt_range[:nu].copy()).unbind(1)
    com = torch.from_numpy(model.body_ipos[scene.index.object_body].copy())
    return ExpertReference.of(expert, low, high, com)
