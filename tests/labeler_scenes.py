"""Scenes for the labeler's tests, each compiled once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from pgdm.config.compose import compose
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.pregrasp.labeler import shapes
from pgdm.pregrasp.labeler.page import LabelPage
from pgdm.pregrasp.labeler.poses import Draft, Poses
from pgdm.pregrasp.labeler.shapes import Shape
from pgdm.pregrasp.labeler.state import LabelState


@cache
def built(task: str, hand: str | None = None) -> EnvBuilder:
    """Return a task's scene and motion."""
    chosen = [f"task={task}", "pregrasp=none", *([f"hand={hand}"] if hand else [])]
    return env_builder(compose(chosen), open_library())


def poses_of(task: str, hand: str | None = None) -> Poses:
    """Return the poses of a task."""
    builder = built(task, hand)
    return Poses(builder.scene, builder.motion)


def state_of(task: str, origin: str = "planned", hand: str | None = None) -> LabelState:
    """Return a pose to edit."""
    return LabelState(built(task, hand).scene, poses_of(task, hand).load(origin).qpos)


@cache
def looks(task: str) -> tuple[list[Shape], list[Shape]]:
    """Return the visible and the collision shapes of a task's scene."""
    return shapes.visible(built(task).scene), shapes.solid(built(task).scene)


@contextmanager
def page_of(task: str, origin: str = "planned") -> Iterator[LabelPage]:
    """Serve a labeler inside the context."""
    builder, poses = built(task), poses_of(task)
    draft = Draft(builder.scene)
    page = LabelPage(
        builder.scene, poses, poses.load(origin), draft, looks(task), builder.motion.substeps, 0
    )
    try:
        yield page
    finally:
        page.close()
        draft.close()
