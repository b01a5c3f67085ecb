"""Which hand and objects a task id means, by the naming rule of TCDM.

``<object>-<motion>`` is an Adroit task, ``<hand>-<object>`` one of the other hands; four ids
name a scene instead of an object and stand in a table.
"""

from __future__ import annotations

HANDS = ("adroit", "dhand", "dmanus")
"""Hands of the benchmark."""

_SPECIAL_OBJECTS: dict[str, tuple[str, ...]] = {
    "hammer-strike": ("dapg_hammer", "nail"),
    "door-open": ("door",),
    "dmanus-sim2real": ("crackerbox",),
}


def task_id(file_stem: str) -> str:
    """Return the task id of a trajectory file: ``hammer_use1`` is ``hammer-use1``."""
    return file_stem.replace("_", "-")


def hand_of(task: str) -> str:
    """Return the hand's name of a task id."""
    first = task.split("-", 1)[0]
    return first if first in HANDS[1:] else HANDS[0]


def objects_of(task: str) -> tuple[str, ...]:
    """Return the library names of a task's objects, the followed one first."""
    if task in _SPECIAL_OBJECTS:
        return _SPECIAL_OBJECTS[task]
    first, _, rest = task.partition("-")
    return (rest if first in HANDS[1:] else first,)
