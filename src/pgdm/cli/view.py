"""``pgdm view``: show a task's exemplar motion, reach, wrist plan or expert hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm.cli.console.screen import bars
from pgdm.cli.scenes import composed, open_env
from pgdm.envs.build import EnvBuilder
from pgdm.envs.film import Clip, film_clip
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library.tasks import MOCAP_TASKS
from pgdm.pregrasp.reach.rollout import play
from pgdm.pregrasp.sources import no_plan
from pgdm.sim.motion_states import expert_marks, expert_qpos, motion_qpos


@dataclass(frozen=True)
class View:
    """Which task to view, and whether in a window or as an MP4."""

    task: str
    hand: str | None
    """None: the task's own."""
    video: Path | None
    """MP4 to write; None: open a window."""
    pregrasp: str
    """Source of the start state."""
    offline: bool

    def open(self, *overrides: str) -> EnvBuilder:
        """Compile the task's environment."""
        return open_env(composed(self.task, self.hand, *overrides, offline=self.offline))

    def open_at_start(self, *overrides: str) -> EnvBuilder:
        """Compile the task's environment with the hand at the chosen start."""
        return self.open(f"pregrasp={self.pregrasp}", *overrides)

    def show(self, builder: EnvBuilder, clip: Clip) -> None:
        """Show a clip in a window, or write it to the MP4."""
        if self.video is None:
            from pgdm.sim.viewer import show_motion

            show_motion(clip.scene.model, clip.qpos, clip.marks)
            return
        fps = round(1 / (builder.motion.substeps * clip.scene.model.opt.timestep))
        with bars() as progress:
            poster = film_clip(clip, fps, self.video, progress)
        print(f"video:  {self.video}")
        print(f"poster: {poster}")


def view_task(view: View) -> None:
    """Replay the exemplar motion with the hand at its pre-grasp; nothing is simulated.

    A translucent copy of the object shows the target. The object itself moves only if its tracked
    body has six joints.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, or nothing can be drawn.
    """
    builder = view.open_at_start()
    scene, reference = builder.scene, builder.mdp.reference
    qpos = motion_qpos(scene, builder.mdp.start.qpos, reference)
    captions = _numbered(scene.task.id, "exemplar motion", len(qpos))
    view.show(builder, Clip(scene, reference, qpos, captions, ghost=True))


def view_reach(view: View) -> None:
    """Play the reach to a start.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, no plan leads to the start, or
            nothing can be drawn.
    """
    builder = view.open_at_start("pregrasp.fallback=null")
    scene, start = builder.scene, builder.mdp.start
    if start.reach is None:
        raise ConfigError(no_plan(start.source, scene))
    qpos = play(scene, start.reach.actions, start.reach.qpos, builder.motion.substeps).qpos
    captions = _numbered(scene.task.id, "reach", len(qpos))
    view.show(builder, Clip(scene, builder.mdp.reference, qpos, captions, hold=True))


def view_wrist(view: View) -> None:
    """Play the hand alone under the planned base commands, and print how closely it follows.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, the hand's base cannot follow a
            plan, or nothing can be drawn.
    """
    builder = view.open_at_start("+experiment=fast")
    plan, task = builder.wrist, builder.scene.task.id
    assert plan is not None  # the experiment asks for one
    print(plan.described())
    captions = [
        f"{task}  hand alone  step {t}  error {100 * error:.1f} cm"
        for t, error in enumerate(np.append(0.0, plan.error_m))
    ]
    clip = Clip(builder.scene, builder.mdp.reference, plan.qpos, captions, ghost=True)
    view.show(builder, clip)


def view_expert(view: View) -> None:
    """Play hand and object together as a person moved them.

    Raises:
        PgdmError: if the task is unknown or has no expert hand trajectory, its assets are
            missing, or nothing can be drawn.
    """
    motion = composed(view.task, view.hand, offline=True).task.motion
    if motion not in MOCAP_TASKS:
        hint = "Only motion-capture tasks have one."
        raise UnknownNameError("expert hand trajectory", motion, MOCAP_TASKS, hint)
    # The recorded poses are those of the mesh's origin. Without reference=com_corrected the fingers
    # would not touch the object where the person's fingers did.
    builder = view.open("method=graff", "pregrasp=mined", "reference=com_corrected")
    scene, mdp, expert = builder.scene, builder.mdp, builder.expert
    assert expert is not None and mdp.expert is not None  # the method needs one
    # Joint positions as published, not clipped to the robot's limits: the person's own motion.
    qpos = expert_qpos(scene, mdp.start.qpos, mdp.reference, expert.qpos)
    title = "expert hand, rebuilt: approximate" if expert.approximate else "expert hand"
    captions = _numbered(scene.task.id, title, len(qpos))
    marks = expert_marks(mdp.reference, mdp.expert)
    view.show(builder, Clip(scene, mdp.reference, qpos, captions, marks=marks))


def _numbered(task: str, title: str, count: int) -> list[str]:
    return [f"{task}  {title}  {t}/{count - 1}" for t in range(count)]
