"""``pgdm view``: a task's exemplar motion, and the hand at its pre-grasp."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.train import notify
from pgdm.config.store import compose
from pgdm.envs.film import film_motion
from pgdm.errors import ConfigError
from pgdm.experiment import env_builder
from pgdm.library import ensure
from pgdm.sim.replay import motion_qpos


def view_task(task: str, video: Path | None, pregrasp: str, offline: bool) -> None:
    """Replay the motion in a window, or into an MP4.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, or nothing can be drawn.
    """
    if video is not None and video.suffix.lower() != ".mp4":
        raise ConfigError(f"--video '{video}' is no MP4; give a name that ends in .mp4")
    cfg = compose([f"task={task}", f"pregrasp={pregrasp}"])
    builder = env_builder(cfg, ensure(cfg.task.motion, offline, notify))
    start, reference = builder.mdp.start, builder.mdp.reference
    for note in builder.notes:
        notify(note)
    if video is None:
        from pgdm.sim.viewer import show_motion

        show_motion(builder.scene.model, motion_qpos(builder.scene, start.qpos, reference))
        return
    poster = film_motion(builder.make(1, 1), video)
    print(f"video:  {video}")
    print(f"poster: {poster}")
