"""The benchmark's 51 tasks: their ids, and the hand and objects that an id names.

``<object>-<motion>`` is a task of the Adroit hand, ``<hand>-<object>`` a task of another hand;
``_SPECIAL_OBJECTS`` lists the exceptions. A task's settings and published results are in
``conf/task/<id>.yaml``.
"""

from __future__ import annotations

HANDS = ("adroit", "dhand", "dmanus")
"""Hands of the benchmark."""

STEP_S = 0.04
"""Duration of a control step, s; ``hammer-strike`` alone has 0.02 s."""
SUBSTEPS = 10
"""Physics steps per control step of every task."""

MOCAP_TASKS = (
    *("airplane-fly1", "airplane-pass1", "alarmclock-lift", "alarmclock-see1", "banana-pass1"),
    *("binoculars-pass1", "cup-drink1", "cup-pour1", "duck-inspect1", "duck-lift"),
    *("elephant-pass1", "eyeglasses-pass1", "flashlight-lift", "flashlight-on2", "flute-pass1"),
    *("fryingpan-cook2", "hammer-use1", "hand-inspect1", "headphones-pass1", "knife-chop1"),
    *("lightbulb-pass1", "mouse-lift", "mouse-use1", "mug-drink3", "piggybank-use1"),
    *("scissors-use1", "spheremedium-lift", "stamp-stamp1", "stanfordbunny-inspect1"),
    *("stapler-lift", "toothbrush-lift", "toothpaste-lift", "toruslarge-inspect1", "train-play1"),
    *("watch-lift", "waterbottle-lift", "waterbottle-shake1", "wineglass-drink1"),
    *("wineglass-drink2", "wineglass-toast1"),
)
"""Motion-capture tasks (GRAB data set); the package ``robohive`` can serve them."""

CHECKOUT_TASKS = (
    *("dhand-alarmclock", "dhand-binoculars", "dhand-cup", "dhand-elephant", "dhand-waterbottle"),
    *("dmanus-coffeecan", "dmanus-crackerbox", "dmanus-sim2real", "door-open", "hammer-strike"),
    "spheremedium-relocate",
)
"""Tasks that only a checkout of TCDM, the paper authors' repository, has."""

BENCHMARK_TASKS = (*MOCAP_TASKS, *CHECKOUT_TASKS)
"""All tasks of the benchmark."""

GRAB_COPIES = frozenset(
    {
        *("dhand-alarmclock", "dhand-binoculars", "dhand-cup", "dhand-elephant"),
        *("dhand-waterbottle", "dmanus-coffeecan"),
    }
)
"""D'Hand and D'Manus tasks whose motion is, at least nearly, that of a motion-capture task."""

REBUILT_EXPERTS = ("alarmclock-see1", "binoculars-pass1", "piggybank-use1", "waterbottle-shake1")
"""Motion-capture tasks whose published expert trajectory is an empty file; pgdm can rebuild it."""

_SPECIAL_OBJECTS: dict[str, tuple[str, ...]] = {
    "hammer-strike": ("dapg_hammer", "nail"),
    "door-open": ("door",),
    "dmanus-sim2real": ("crackerbox",),
}


def task_id(file_stem: str) -> str:
    """Return the task id of a trajectory file, such as ``hammer-use1`` for ``hammer_use1``."""
    return file_stem.replace("_", "-")


def hand_of(task: str) -> str:
    """Return the name of a task's hand."""
    first = task.split("-", 1)[0]
    return first if first in HANDS[1:] else HANDS[0]


def objects_of(task: str) -> tuple[str, ...]:
    """Return the library names of a task's objects, the tracked one first."""
    if task in _SPECIAL_OBJECTS:
        return _SPECIAL_OBJECTS[task]
    first, _, rest = task.partition("-")
    return (rest if first in HANDS[1:] else first,)
