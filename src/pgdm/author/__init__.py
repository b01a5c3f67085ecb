"""New tasks: an object, a hand, a motion and a pre-grasp become one more task of the user's."""

from __future__ import annotations

from pgdm.author.task import AuthoredTask, TaskRequest, author_task

__all__ = ["AuthoredTask", "TaskRequest", "author_task"]
