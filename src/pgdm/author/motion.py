"""The motion of a new task: read it, repair it on request, start it at rest, and check it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError, check_name
from pgdm.library.authored import own
from pgdm.library.authored.drop import Drop, drop
from pgdm.library.checks import motion as motion_checks
from pgdm.library.checks.motion import Poses, TableCheck
from pgdm.library.files import keyframes as animate
from pgdm.library.files import poses as pose_file
from pgdm.library.files.columns import check_order
from pgdm.library.files.keyframes import STEP_S, continuous

ORIGINS = ("com", "mesh")

NEAR_M, NEAR_RAD = 0.01, 0.17
"""Distance and angle between first pose and resting pose up to which the motion is blended to start
at rest; if they are farther apart, ``--settle`` is needed."""
_BLEND_STEPS = 15  # control steps of the blend
_NAME_THEM = (
    "name the columns: a first line x,y,z,qx,qy,qz,qw in a .csv, 'columns' in a .json or .npz"
)
_TABLE_M = 0.4  # half of the table's side minus a margin


@dataclass(frozen=True)
class MotionRequest:
    """Where a motion comes from, and how to change it.

    Exactly one of ``keyframes`` and ``poses`` is given.
    """

    keyframes: Path | None
    """YAML file of keyframes."""
    poses: Path | None
    """Recorded poses: .csv, .npz or .json."""
    origin: str = "com"
    """Point whose positions were recorded: ``com``, the centre of mass, or ``mesh``, the origin of
    the mesh file."""
    smooth: bool = False
    """Filter the motion, and start and end it at rest."""
    slower: float = 1.0
    """Factor by which to slow the motion down."""
    lift: bool = False
    """Raise poses that cut into the table."""
    settle: bool = False
    """Start where the object comes to rest, however far that is: shift all positions by one vector,
    and turn the object by one rotation in all poses, about its own axes."""


@dataclass(frozen=True)
class CheckedMotion:
    """A motion that passed all checks."""

    poses: Poses
    """The motion; in its first pose the object rests on the table."""
    notes: list[str]
    """Changes, a sentence each."""
    source: str
    """``trajectory_source`` of the task's file: ``animator`` or ``recorded``."""


def make_motion(
    request: MotionRequest, object_xml: Path, model: mujoco.MjModel, body: int
) -> CheckedMotion:
    """Read, change and check the motion of a task.

    Args:
        request: where the motion comes from.
        object_xml: the object's model.
        model: the task's scene.
        body: id of the object's body in the scene.

    Raises:
        ConfigError: there is not exactly one motion, ``origin`` does not fit it, or the motion is
            impossible; the message then states a remedy.
        CorruptAssetError: the motion's file is damaged.
    """
    if (request.keyframes is None) == (request.poses is None):
        raise ConfigError("a task needs one motion: --keyframes FILE or --poses FILE")
    check_name("origin", request.origin, ORIGINS)
    if request.keyframes is not None and request.origin != "com":
        raise ConfigError(
            f"--origin {request.origin} is for --poses; keyframes state the centre of mass"
        )
    notes: list[str] = []
    if request.keyframes is not None:
        poses, label = _animated(request.keyframes, object_xml, notes), str(request.keyframes)
    else:
        assert request.poses is not None
        poses, label = _recorded(request, object_xml, model, body, notes), str(request.poses)
    if request.slower != 1.0:
        poses = motion_checks.slower(poses, request.slower)
        notes.append(f"slowed down by a factor of {request.slower:g}")
    if request.smooth:
        poses = motion_checks.smoothed(poses)
        notes.append("smoothed, with a rest added before and after")
    poses = _started_at_rest(poses, request.settle, object_xml, label, notes)
    table = TableCheck(model, body)
    if request.lift:
        raised = table.lifted(poses)
        most = float((raised.pos - poses.pos)[:, 2].max())
        if most > 0:
            notes.append(f"raised by up to {1e3 * most:.0f} mm where it cut into the table")
        poses = raised
    motion_checks.check_motion(poses, label)
    table.check(poses, label)
    return CheckedMotion(poses, notes, "recorded" if request.keyframes is None else "animator")


def _animated(path: Path, object_xml: Path, notes: list[str]) -> Poses:
    animation = animate.read(path)
    if animation.frame == "world":
        return Poses(*animation.trajectory())
    turn = Rotation.from_quat(animation.quat, scalar_first=True)
    rest = drop(object_xml, (float(animation.place[0]), float(animation.place[1])), turn)
    _check_rest(rest, str(path))
    if rest.turned_rad > NEAR_RAD:
        notes.append(
            "the object falls over from the pose in which it is put on the table, by "
            f"{np.rad2deg(rest.turned_rad):.0f} degrees; the motion starts where it comes to rest"
        )
    return Poses(*animation.at(rest.com, rest.quat))


def _recorded(
    request: MotionRequest, object_xml: Path, model: mujoco.MjModel, body: int, notes: list[str]
) -> Poses:
    assert request.poses is not None
    found = pose_file.read(request.poses)
    notes += found.repairs
    if not found.named:
        rest = Rotation.from_quat(drop(object_xml).quat, scalar_first=True)
        check_order(found.quat[0], rest, f"{request.poses}: row 0", _NAME_THEM)
    if request.origin == "com":
        return Poses(found.pos, found.quat)
    offset = model.body_ipos[body]
    name = model.body(body).name.split("/")[0]
    if name in own.read().objects:
        offset = np.array(own.facts(name)["origin_in_mesh_m"])
    turns = Rotation.from_quat(found.quat, scalar_first=True)
    return Poses(found.pos + turns.apply(offset), found.quat)


def _started_at_rest(
    poses: Poses, settle: bool, object_xml: Path, label: str, notes: list[str]
) -> Poses:
    """Return the motion, shifted or blended so that in its first pose the object rests."""
    first = Rotation.from_quat(poses.quat[0], scalar_first=True)
    place = float(poses.pos[0, 0]), float(poses.pos[0, 1])
    if max(abs(place[0]), abs(place[1])) > _TABLE_M:
        raise ConfigError(
            f"{label}: starts at x = {place[0]:.2f}, y = {place[1]:.2f} m, off the table or near "
            f"its edge; valid: at most {_TABLE_M:g} m from the centre in x and in y"
        )
    rest = drop(object_xml, place, first)
    _check_rest(rest, label)
    away = float(np.linalg.norm(rest.com - poses.pos[0]))
    if (away > NEAR_M or rest.turned_rad > NEAR_RAD) and not settle:
        raise ConfigError(
            f"{label}: the object does not rest where the motion starts: it settles "
            f"{100 * away:.1f} cm away, turned by {np.rad2deg(rest.turned_rad):.0f} degrees; "
            "--settle shifts and turns the motion to start where the object rests"
        )
    turn = Rotation.from_quat(rest.quat, scalar_first=True) * first.inv()
    turns = Rotation.from_quat(poses.quat, scalar_first=True)
    if settle:
        notes.append(f"shifted by {1e3 * away:.0f} mm, and turned, to start where the object rests")
        quat = (turns * first.inv() * turn * first).as_quat(scalar_first=True)
        return Poses(poses.pos - poses.pos[0] + rest.com, continuous(quat))
    if away > 1e-4 or rest.turned_rad > 1e-3:
        notes.append(
            f"the motion's first {_BLEND_STEPS * STEP_S:.1f} s were blended to start where the "
            f"object rests, {1e3 * away:.1f} mm and {np.rad2deg(rest.turned_rad):.1f} degrees away"
        )
    share = np.clip(1.0 - np.arange(len(poses.pos)) / _BLEND_STEPS, 0.0, 1.0)
    share = share**3 * (10 - 15 * share + 6 * share**2)  # minimum-jerk blend from 1 to 0
    bends = Rotation.from_rotvec(np.outer(share, turn.as_rotvec()))
    quat = (bends * turns).as_quat(scalar_first=True)
    return Poses(poses.pos + np.outer(share, rest.com - poses.pos[0]), continuous(quat))


def _check_rest(rest: Drop, label: str) -> None:
    if not rest.rests:
        raise ConfigError(
            f"{label}: the object does not come to rest on the table from its starting "
            f"pose: after 4 s it moves at {100 * rest.speed_m_s:.1f} cm/s, or turns, drifts or has "
            "sunk too far; turn it so that it lies stably"
        )
