"""``pgdm author remove``: remove one of the user's objects, hands or tasks."""

from __future__ import annotations

from pgdm.cli.console.screen import confirmed
from pgdm.library.authored import own


def run(name: str, sure: bool) -> None:
    """Remove an object, a hand or a task of the user's, after confirmation.

    Args:
        name: name of the object, hand or task.
        sure: whether to skip the question.

    Raises:
        UnknownNameError: the user has nothing of that name.
        LibraryError: it is an object or a hand that tasks still use.
    """
    kind = own.kind_of(own.read(), name)
    if kind != "task":
        own.check_unused(name)
    if not sure and not confirmed(f"remove the {kind} '{name}'? This cannot be undone"):
        print("nothing was removed")
        return
    if kind == "object":
        own.remove(name)
    elif kind == "hand":
        from pgdm.author.hand import remove_hand

        remove_hand(name)
    else:
        from pgdm.author.task import remove_task  # imported here because it loads torch

        if (aside := remove_task(name)) is not None:
            print(f"the task's pre-grasps are kept in {aside}")
    print(f"removed the {kind} '{name}'")
