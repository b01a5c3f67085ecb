"""The user's own tasks, each made of an object, a hand, a motion and a pre-grasp."""

from __future__ import annotations

from pgdm.author.task import AuthoredTask, TaskRequest, author_task

__all__ = ["AuthoredTask", "TaskRequest", "author_task"]
