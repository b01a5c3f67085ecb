"""Scenes of tasks, each compiled once for all tests."""

from __future__ import annotations

from functools import cache

from pgdm.config.compose import compose
from pgdm.library import Motion, open_library
from pgdm.sim.scene import Scene, build_scene


@cache
def opened(task: str, hand: str | None = None, *settings: str) -> tuple[Scene, Motion]:
    """Return a task's scene, by default with its own hand, and its motion."""
    chosen = [f"task={task}", *([] if hand is None else [f"hand={hand}"]), *settings]
    cfg, library = compose(chosen), open_library()
    return build_scene(library, cfg.task, cfg.hand, cfg.sim), library.motion(cfg.task.motion)
