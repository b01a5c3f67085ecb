"""Pre-grasps cut from tele-operated demonstrations, just before the hand takes hold.

A demonstration's states are put into the task's own scene, kinematically, and moved as a whole so
that the object stands where the task has it; the simulator's contacts say when the hand touches.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import Start
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.pregrasp.demonstrations import Demonstration
from pgdm.sim.contact import FREE_M, HandContact
from pgdm.sim.scene import Scene

LASTING_STEPS = 5
"""A contact of fewer control steps, 0.2 s, is a brush in passing."""
FITS_M = 0.01
"""A demonstration whose palm this scene's hand misses by more was made with another hand."""
BEYOND_M = 0.02
"""A hand whose slides would have to go this much beyond their ranges cannot be where it was."""


@dataclass(frozen=True)
class Layout:
    """What the numbers of an observation are, and which joints of the task's scene they set."""

    environment: str
    """Who made them, for people."""
    size: int
    """Numbers in an observation."""
    joints: dict[int, slice]
    """Joints from a number on, each to part of the observation."""
    palm: slice
    """Position of the palm's site in the world (3)."""
    palm_site: str
    thing: slice
    """Position of a site of the object in the world (3)."""
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
"""Observations that can be read, by task."""


@dataclass(frozen=True)
class Replay:
    """A demonstration in the task's scene."""

    number: int
    qpos: np.ndarray = field(repr=False)
    """Whole scene (T, nq) at each step, slides within their ranges."""
    shift_m: float
    """How far the object stood from where the task has it."""
    beyond_m: float
    """By how much the slides would have to leave their ranges at the step before it takes hold."""
    palm_error_m: float
    """Worst distance of the palm from where it was observed, before slides were clipped: what of it
    the vertical and sideways slides have to make up, which the demonstrations' hand does not have.
    """
    touching: np.ndarray = field(repr=False)
    """Whether the hand touches anything at each step (T,)."""

    @property
    def hold(self) -> int | None:
        """First step of a contact that lasts; None if there is none."""
        run = 0
        for step, touches in enumerate(self.touching):
            run = run + 1 if touches else 0
            if run == LASTING_STEPS:
                return step - LASTING_STEPS + 1
        return None


def layout_of(task: str) -> Layout:
    """Return how a task's demonstrations are laid out.

    Raises:
        UnknownNameError: no layout of its observations is known.
    """
    if task not in LAYOUTS:
        raise UnknownNameError(
            "task with known demonstrations",
            task,
            LAYOUTS,
            "Other observations cannot be read yet.",
        )
    return LAYOUTS[task]


def replay(scene: Scene, demonstration: Demonstration) -> Replay:
    """Put a demonstration's states into the task's scene.

    Raises:
        UnknownNameError: no layout of the task's observations is known.
        ConfigError: the observations are of another size, the hand is another, or a step is missed.
    """
    layout = layout_of(scene.task.id)
    observed, model, nu = demonstration.observations, scene.model, scene.model.nu
    label = f"demonstration {demonstration.number}"
    if observed.shape[1] != layout.size:
        raise ConfigError(
            f"{label} has observations of {observed.shape[1]} numbers; those of "
            f"{layout.environment} have {layout.size}"
        )
    if (site := layout.palm_site.partition("/")[0]) != scene.hand.name:
        raise ConfigError(
            f"demonstrations of {scene.task.id} are of hand {site}, not {scene.hand.name}; follow "
            f"them with another hand by pgdm pregrasp mocap {scene.task.id} --hand"
        )
    data, contact = mujoco.MjData(model), HandContact(scene)
    mujoco.mj_kinematics(model, data)
    axes = data.xaxis[:3].copy()  # of the slides, rows, world frame
    palm, thing = (model.site(name).id for name in (layout.palm_site, layout.thing_site))
    qpos = np.zeros((len(observed), model.nq))
    for first, part in layout.joints.items():
        values = observed[:, part]
        qpos[:, first : first + values.shape[1]] = values
    slides = np.empty((len(observed), 3))
    shift = np.zeros(3)
    for step, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        if step == 0:
            shift = data.site_xpos[thing] - observed[0, layout.thing]
        slides[step] = axes @ (observed[step, layout.palm] - data.site_xpos[palm])
    # The demonstrations' hand slides along its third axis only: the rest is a measure of the fit.
    missed = float(np.abs(slides[:, :2]).max())
    if missed > FITS_M:
        raise ConfigError(
            f"{label}: the palm is up to {1e3 * missed:.0f} mm from where this hand has it; "
            f"it was made with another hand than that of {layout.environment}"
        )
    slides += axes @ shift
    low, high = model.jnt_range[:nu].T
    qpos[:, :3] = slides.clip(low[:3], high[:3])
    qpos[:, 3:nu] = qpos[:, 3:nu].clip(low[3:], high[3:])
    touching = np.array([contact.depth(row) > 0 for row in qpos])
    made = Replay(demonstration.number, qpos, float(np.linalg.norm(shift)), 0.0, missed, touching)
    end = len(qpos) if made.hold is None else made.hold
    beyond = np.abs(slides - qpos[:, :3])[max(end - 1, 0)]
    return Replay(made.number, qpos, made.shift_m, float(beyond.max()), missed, touching)


def cut(scene: Scene, made: Replay, objects: np.ndarray, origin: str) -> Pregrasp:
    """Return the pre-grasp just before a demonstration takes hold.

    Args:
        scene: of the task.
        made: the demonstration in it.
        objects: where the task starts, joints of its objects (nq - nu,): a door that had been
            brushed open a little is closed again.
        origin: the file, for people.

    Raises:
        ConfigError: the hand never takes hold, does so from the first step on, or cannot be there.
    """
    label = f"demonstration {made.number} of {origin}"
    hold = made.hold
    if hold is None:
        raise ConfigError(f"{label}: the hand touches nothing for {LASTING_STEPS} steps or more")
    if hold == 0:
        raise ConfigError(f"{label}: the hand holds something from the first step on")
    if made.beyond_m > BEYOND_M:
        raise ConfigError(
            f"{label}: its object stands {1e2 * made.shift_m:.0f} cm from the task's, and the "
            f"slides of hand '{scene.hand.name}' would have to go {1e3 * made.beyond_m:.0f} mm "
            "beyond their ranges to follow; take another demonstration"
        )
    contact = HandContact(scene)
    step, qpos = hold - 1, made.qpos[hold - 1].copy()
    qpos[scene.model.nu :] = objects
    while step > 0 and contact.depth(qpos) > 0:
        step -= 1
        qpos[: scene.model.nu] = made.qpos[step, : scene.model.nu]
    if (depth := contact.depth(qpos)) > FREE_M:
        raise ConfigError(
            f"{label}: the hand is inside something from the first step on ({1e3 * depth:.1f} mm)"
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
    """Return the demonstration that takes hold and whose object stood nearest to the task's.

    Raises:
        ConfigError: none takes hold within the slides' ranges.
    """
    fit = [r for r in replays if r.hold and r.beyond_m <= BEYOND_M]
    if not fit:
        raise ConfigError(f"none of {len(replays)} demonstrations takes hold where the hand can be")
    return min(fit, key=lambda r: (r.shift_m, r.number))
