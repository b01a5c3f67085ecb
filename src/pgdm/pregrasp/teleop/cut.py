"""Pre-grasps cut from tele-operated demonstrations, just before the hand takes hold.

The states of a demonstration are set kinematically in the task's scene, translated together so that
the object is where the task has it. The simulator's contacts then show when the hand takes hold.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import Start
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp.teleop.demonstrations import Demonstration
from pgdm.sim.contact import FREE_M, HandContact
from pgdm.sim.scene import Scene

LASTING_STEPS = 5
"""The hand takes hold if a contact lasts at least this many control steps (0.2 s)."""
FITS_M = 0.01
"""If the palm misses its observed position by more, the demonstration counts as another hand's."""
BEYOND_M = 0.02
"""Largest distance by which a demonstration may exceed the slides' ranges."""


@dataclass(frozen=True)
class Layout:
    """Layout of an observation, and the joints of the task's scene that it sets."""

    environment: str
    """Name of the environment that the observations come from, for messages."""
    size: int
    """Length of an observation."""
    joints: dict[int, slice]
    """Slices of the observation that hold joint positions. The key of a slice is the index in qpos
    at which it is written."""
    palm: slice
    """Slice that holds the world position (3) of ``palm_site``, m."""
    palm_site: str
    thing: slice
    """Slice that holds the world position (3) of ``thing_site``, a site of the object, m."""
    thing_site: str


LAYOUTS = {
    # The base's three slides are not observed; the palm's position gives them.
    "door-open": Layout(
        environment="AdroitHandDoor (DAPG, Gymnasium-Robotics, D4RL)",
        size=39,
        joints={3: slice(0, 27), 30: slice(28, 29), 31: slice(27, 28)},
        palm=slice(29, 32),
        palm_site="adroit/S_grasp",
        thing=slice(32, 35),
        thing_site="door/S_handle",
    )
}
"""Known layouts, by task id."""


@dataclass(frozen=True)
class Replay:
    """A demonstration set in the task's scene."""

    number: int  # of the demonstration in its file, from 0
    qpos: np.ndarray = field(repr=False)
    """Whole scene (T, nq) at each step, the hand's joints clipped to their ranges."""
    shift_m: float
    """Distance between the object's positions in the demonstration and in the task."""
    beyond_m: float
    """How far the slides would have to exceed their ranges in the step before the hold; without a
    hold, in the last step."""
    palm_error_m: float
    """Largest distance of the palm from its observed position along the first two slides, which the
    demonstrations' hand does not have."""
    touching: np.ndarray = field(repr=False)
    """Whether the hand touches anything in each step (T,), bool."""

    @property
    def hold(self) -> int | None:
        """First step of the first contact that lasts :data:`LASTING_STEPS`; None if none does."""
        run = 0
        for step, touches in enumerate(self.touching):
            run = run + 1 if touches else 0
            if run == LASTING_STEPS:
                return step - LASTING_STEPS + 1
        return None


def layout_of(task: str) -> Layout:
    """Return the layout of a task's observations.

    Raises:
        UnknownNameError: no layout is known for the task.
    """
    if task not in LAYOUTS:
        hint = "Other observations cannot be read yet."
        raise UnknownNameError("task with known demonstrations", task, LAYOUTS, hint)
    return LAYOUTS[task]


def replay(scene: Scene, demonstration: Demonstration) -> Replay:
    """Set a demonstration's states in the task's scene.

    Raises:
        UnknownNameError: no layout is known for the task.
        ConfigError: the observations have another size or are of another hand.
    """
    layout, model, n = layout_of(scene.task.id), scene.model, scene.index.num_joints
    _check(scene, demonstration, layout)
    observed, contact = demonstration.observations, HandContact(scene)
    qpos = np.zeros((len(observed), model.nq))
    for first, part in layout.joints.items():
        values = observed[:, part]
        qpos[:, first : first + values.shape[1]] = values
    slides, axes, shift = _slides(scene, observed, qpos, layout)
    # The demonstrations' hand has only the third slide: the first two should come out as 0.
    missed = float(np.abs(slides[:, :2]).max())
    if missed > FITS_M:
        raise ConfigError(
            f"demonstration {demonstration.number}: the palm is up to {1e3 * missed:.0f} mm from "
            f"its observed position; recorded with another hand than that of {layout.environment}"
        )
    slides += axes @ shift
    low, high = model.jnt_range[:n].T
    qpos[:, :3] = slides.clip(low[:3], high[:3])
    qpos[:, 3:n] = qpos[:, 3:n].clip(low[3:], high[3:])
    touching = np.array([contact.depth(row) > 0 for row in qpos])
    made = Replay(demonstration.number, qpos, float(np.linalg.norm(shift)), 0.0, missed, touching)
    end = len(qpos) if made.hold is None else made.hold
    beyond = np.abs(slides - qpos[:, :3])[max(end - 1, 0)]
    return replace(made, beyond_m=float(beyond.max()))


def _check(scene: Scene, demonstration: Demonstration, layout: Layout) -> None:
    size = demonstration.observations.shape[1]
    if size != layout.size:
        raise ConfigError(
            f"demonstration {demonstration.number} has observations of {size} numbers; those of "
            f"{layout.environment} have {layout.size}"
        )
    if (hand := layout.palm_site.partition("/")[0]) != scene.hand.name:
        raise ConfigError(
            f"demonstrations of {scene.task.id} are of hand {hand}, not {scene.hand.name}; for "
            f"another hand use 'pgdm pregrasp mocap {scene.task.id} --hand NAME'"
        )


def _slides(
    scene: Scene, observed: np.ndarray, qpos: np.ndarray, layout: Layout
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slides (T, 3) m that bring the palm of qpos (T, nq) to its observed positions.

    Also returns the slides' axes as rows (3, 3), world frame, and the vector (3,) m from the
    object's observed position in the first step to its position in the scene.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    axes = data.xaxis[:3].copy()
    palm, thing = (model.site(name).id for name in (layout.palm_site, layout.thing_site))
    slides, shift = np.empty((len(observed), 3)), np.zeros(3)
    for step, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        if step == 0:
            shift = data.site_xpos[thing] - observed[0, layout.thing]
        slides[step] = axes @ (observed[step, layout.palm] - data.site_xpos[palm])
    return slides, axes, shift


def cut(scene: Scene, made: Replay, objects: np.ndarray, origin: str) -> Pregrasp:
    """Return the pre-grasp just before a demonstration takes hold.

    Args:
        scene: scene of the task.
        made: the demonstration set in this scene.
        objects: joint positions of the objects at the task's start (nq - n,). They replace those in
            the demonstration, where a door, for instance, may have been brushed open.
        origin: the demonstration's file, for messages.

    Raises:
        ConfigError: the hand never takes hold, does so in the first step, would have to exceed its
            slides' ranges, or is inside something in every step before the hold.
    """
    label = f"demonstration {made.number} of {origin}"
    hold = made.hold
    if hold is None:
        raise ConfigError(
            f"{label}: the hand never touches anything for {LASTING_STEPS} steps in a row"
        )
    if hold == 0:
        raise ConfigError(f"{label}: the hand already holds something in the first step")
    if made.beyond_m > BEYOND_M:
        raise ConfigError(
            f"{label}: the object is {1e2 * made.shift_m:.0f} cm from the task's, and the slides "
            f"of hand '{scene.hand.name}' would have to exceed their ranges by "
            f"{1e3 * made.beyond_m:.0f} mm to follow; choose another demonstration"
        )
    contact = HandContact(scene)
    step, qpos = hold - 1, made.qpos[hold - 1].copy()
    qpos[scene.index.num_joints :] = objects
    while step > 0 and contact.depth(qpos) > 0:
        step -= 1
        qpos[: scene.index.num_joints] = made.qpos[step, : scene.index.num_joints]
    if (depth := contact.depth(qpos)) > FREE_M:
        raise ConfigError(
            f"{label}: the hand is already {1e3 * depth:.1f} mm inside something in the first step"
        )
    note: dict[str, Any] = {
        "made_by": "tele-operation",
        "from": origin,
        "demonstration": made.number,
        "step": step,
        "takes_hold_at": hold,
        "object_shift_mm": round(1e3 * made.shift_m, 1),
        "beyond_range_mm": round(1e3 * made.beyond_m, 1),
        "palm_error_mm": round(1e3 * made.palm_error_m, 1),
        "depth_mm": round(1e3 * depth, 2),
    }
    return Pregrasp(Start(qpos, np.zeros(scene.model.nv), None), None, note)


def nearest(replays: list[Replay]) -> Replay:
    """Return, of the demonstrations that take hold, the one with the object nearest to the task's.

    Raises:
        ConfigError: no demonstration takes hold within the slides' ranges.
    """
    fit = [r for r in replays if r.hold and r.beyond_m <= BEYOND_M]
    if not fit:
        raise ConfigError(
            f"none of {len(replays)} demonstrations takes hold within the ranges of the slides"
        )
    return min(fit, key=lambda r: (r.shift_m, r.number))
