"""``pgdm view``: a task's exemplar motion, the reach before it, and the expert's hand."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.envs.film import film_expert, film_motion, film_reach, film_wrist
from pgdm.errors import ConfigError
from pgdm.experiment import assets, env_builder
from pgdm.library import ensure_expert
from pgdm.pregrasp.rollout import play
from pgdm.pregrasp.sources import no_plan
from pgdm.sim.replay import expert_marks, expert_qpos, motion_qpos


def view_task(
    task: str, hand: str | None, video: Path | None, pregrasp: str, offline: bool
) -> None:
    """Replay the motion in a window, or into an MP4.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, or nothing can be drawn.
    """
    _check(video)
    cfg = composed(task, hand, f"pregrasp={pregrasp}", f"offline={str(offline).lower()}")
    builder = env_builder(cfg, assets(cfg, notify))
    start, reference = builder.mdp.start, builder.mdp.reference
    for note in builder.notes:
        notify(note)
    if video is None:
        from pgdm.sim.viewer import show_motion

        show_motion(builder.scene.model, motion_qpos(builder.scene, start.qpos, reference))
        return
    _say(video, film_motion(builder.make(1, 1), video))


def view_reach(
    task: str, hand: str | None, video: Path | None, pregrasp: str, offline: bool
) -> None:
    """Play the plan that leads to a start, in a window, or into an MP4.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, no plan leads to the start, or
            nothing can be drawn.
    """
    _check(video)
    start = f"pregrasp={pregrasp}", "pregrasp.fallback=null"
    cfg = composed(task, hand, *start, f"offline={str(offline).lower()}")
    builder = env_builder(cfg, assets(cfg, notify))
    scene, source, reach = builder.scene, builder.mdp.start.source, builder.mdp.start.reach
    if reach is None:
        raise ConfigError(no_plan(source, scene))
    qpos = play(scene, reach.actions, reach.qpos, builder.motion.substeps).qpos
    if video is None:
        from pgdm.sim.viewer import show_motion

        show_motion(scene.model, qpos)
        return
    _say(video, film_reach(builder.make(1, 1), qpos, video))


def view_wrist(
    task: str, hand: str | None, video: Path | None, pregrasp: str, offline: bool
) -> None:
    """Play what the hand alone does with the planned commands of its wrist; print how near it is.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, the hand's base cannot follow a
            plan, or nothing can be drawn.
    """
    _check(video)
    planned = "+experiment=fast", f"pregrasp={pregrasp}", f"offline={str(offline).lower()}"
    cfg = composed(task, hand, *planned)
    builder = env_builder(cfg, assets(cfg, notify), notify)
    plan = builder.wrist
    assert plan is not None  # the experiment wants one
    print(plan.described())
    if video is None:
        from pgdm.sim.viewer import show_motion

        show_motion(builder.scene.model, plan.qpos)
        return
    _say(video, film_wrist(builder.make(1, 1), plan, video))


def view_expert(task: str, video: Path | None, offline: bool) -> None:
    """Play hand and object together as a person moved them, in a window, or into an MP4.

    Raises:
        PgdmError: if the task is unknown or has no expert hand trajectory, its assets are
            missing, or nothing can be drawn.
    """
    _check(video)
    library = ensure_expert(composed(task, None).task.motion, offline, notify)
    # The recorded pose is that of the mesh's origin: only so the fingers lie where they lay.
    cfg = composed(task, None, "method=graff", "pregrasp=mined", "reference=com_corrected")
    builder = env_builder(cfg, library)
    scene, mdp, expert = builder.scene, builder.mdp, builder.expert
    assert expert is not None and mdp.expert is not None  # the method needs one
    for note in builder.notes:
        notify(note)
    reference = mdp.reference
    # As published, not clipped to the limits: what the person did, not what the robot can do.
    qpos = expert_qpos(scene, mdp.start.qpos, reference, expert.qpos)
    marks = expert_marks(reference, mdp.expert)
    if video is None:
        from pgdm.sim.viewer import show_motion

        show_motion(scene.model, qpos, marks)
        return
    title = "expert hand, rebuilt: approximate" if expert.approximate else "expert hand"
    _say(video, film_expert(scene, qpos, marks, reference, title, video))


def _check(video: Path | None) -> None:
    if video is not None and video.suffix.lower() != ".mp4":
        raise ConfigError(f"--video '{video}' is no MP4; give a name that ends in .mp4")


def _say(video: Path, poster: Path) -> None:
    print(f"video:  {video}")
    print(f"poster: {poster}")
