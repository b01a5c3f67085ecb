"""Make a user's hand: read and analyse the file, mount and check the hand, and store it."""

from __future__ import annotations

import json
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pgdm import paths
from pgdm.author.hand import anatomy as parts
from pgdm.author.hand import build as models
from pgdm.author.hand import servos as actuators
from pgdm.author.hand.anatomy import Anatomy
from pgdm.author.hand.checks import Checks, check, overlapping
from pgdm.author.hand.settings import settings_path, settings_text
from pgdm.config.groups import conf_dir
from pgdm.errors import ConfigError, SceneError
from pgdm.library import manifest
from pgdm.library.authored import hand_file, own
from pgdm.library.authored.hand_file import HandFile
from pgdm.library.files import model as model_file
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.flexion import Flexion
from pgdm.pregrasp.hand_geometry import straight
from pgdm.sim.scene import HandCfg, Scene, bare_scene

R = TypeVar("R")

MEAN_SHARE = 0.37
"""In the *mean hand*, the fingers are as in a mean pre-grasp: each joint that closes a finger is at
this share of the way from straight to closed. The value is the mean over the benchmark's three
hands, which have 0.38, 0.35 and 0.39."""

_KP = (0.01, 1000.0)
_PLACE_M = ((-1.0, 1.0), (-1.5, 0.5), (0.0, 1.5))


@dataclass(frozen=True)
class HandRequest:
    """A hand to create."""

    file: Path
    """MJCF or URDF."""
    name: str
    """Name of the hand in the library."""
    root: Path | None = None
    """Folder that must contain all meshes; None: the file's folder."""
    fingers: Mapping[str, str] = field(default_factory=dict)
    """A link or joint of each human finger; empty: find the fingers by names or geometry."""
    reset: Mapping[str, float] = field(default_factory=dict)
    """Reset position of joints, rad or m; other joints: zero, or the limit nearest to zero."""
    kp: float | None = None
    """Gain of the servos of wrist and fingers, N m/rad; None: the file's, or 3."""
    place: tuple[float, float, float] = models.WRIST_M
    """Position of the wrist with the base joints at zero, m, world frame."""
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation about the world's x, then y, then z axis; at zero the fingers point along y and the
    palm faces down."""
    drop_tendons: bool = False
    """Leave out tendons that actuators drive; otherwise they are an error."""
    licence: str = "unstated"
    """Licence of the model, preferably as its SPDX identifier."""
    replace: bool = False
    """Replace a hand of the same name."""


@dataclass(frozen=True)
class AuthoredHand:
    """A new hand."""

    name: str
    folder: Path
    settings: Path
    source: HandFile
    anatomy: Anatomy
    cfg: HandCfg
    scene: Scene
    """The hand above a table, without a task."""
    side: str
    """``right`` or ``left``."""
    servos: dict[str, actuators.Servo]
    mean: np.ndarray
    """Joint positions (n,), m and rad, of the mean hand (see :data:`MEAN_SHARE`), base at zero."""
    checks: Checks
    notes: list[str]
    """What was changed or left out."""


def author_hand(request: HandRequest, progress: StepProgress = silent) -> AuthoredHand:
    """Create a hand from an MJCF or URDF file.

    Args:
        request: the hand to create.
        progress: receives the steps.

    Raises:
        ConfigError: a value is wrong, a name is taken, fingers cannot be distinguished, or joints,
            actuators or constraints are not supported.
        CorruptAssetError: the file cannot be used; the message says why.
        SceneError: the resulting model does not compile or fails a check.
        LibraryError: the user's folder cannot be written.
    """
    _check(request)
    label = request.file.name
    progress("reading the hand", 0, 4)
    source = hand_file.read(request.file, request.root)
    notes = list(source.notes)
    light = _quietly(models.light, source.xml)
    model = models.named(light).compile()
    servos, changed = actuators.servos(model, request.kp, request.drop_tendons, label)
    ranges, also = actuators.narrowed(model)
    notes += [*changed, *also]
    for name, span in ranges.items():
        model.jnt_range[model.joint(name).id] = span
    found = parts.find(model, request.fingers, label)
    reset = models.reset_of(model, request.reset, label)
    progress("orienting the hand", 1, 4)
    plan = models.Plan(
        *(request.name, np.eye(3), np.zeros(3), servos, ranges),
        *(source.kind == "URDF", reset, []),
    )
    cfg = _settings(request.name, found)
    normal = _palm_normal(light, found, plan, cfg)
    rotation, side = _mounted(found, normal, request.turn_deg)
    plan = replace(plan, rotation=rotation, place=np.array(request.place))
    plan = replace(plan, excluded=overlapping(_scene(light, found, plan, cfg)))
    if said := _other_side(label, source.xml, side):
        notes.append(said)
    progress("checking the hand", 2, 4)
    root = _quietly(models.build, source.xml, found, plan)
    scene = _compiled(root, cfg)
    mean = _mean(scene)
    cfg = replace(cfg, mean_fingers_rad=[float(q) for q in mean[6 + cfg.num_wrist_joints :]])
    scene = replace(scene, hand=cfg)
    checks = check(scene, plan.excluded, mean)
    progress("writing the hand", 3, 4)
    folder = _store(request, root, cfg, source, notes, side, found)
    progress("writing the hand", 4, 4)
    return AuthoredHand(
        *(request.name, folder, settings_path(request.name), source, found, cfg, scene, side),
        *(servos, mean, checks, notes),
    )


def remove_hand(name: str) -> None:
    """Remove a hand of the user's and its settings.

    Raises:
        UnknownNameError: the user has no such hand.
        LibraryError: a task still uses it.
    """
    own.remove(name)
    settings_path(name).unlink(missing_ok=True)


def _check(request: HandRequest) -> None:
    shipped = [path.stem for path in (conf_dir() / "hand").glob("*.yaml")]
    own.check_hand_name(request.name, shipped, request.replace)
    path = settings_path(request.name)
    if request.name not in own.read().hands and path.exists():
        raise ConfigError(
            f"hand name '{request.name}' is taken by your file {path}; choose another"
        )
    if not request.file.is_file():
        raise ConfigError(f"there is no file '{request.file}'; check the path")
    if request.kp is not None and not _KP[0] <= request.kp <= _KP[1]:
        raise ConfigError(f"--kp is {request.kp:g}; valid: {_KP[0]:g} to {_KP[1]:g} N m/rad")
    for axis, value, (low, high) in zip("xyz", request.place, _PLACE_M, strict=True):
        if not low <= value <= high:
            raise ConfigError(f"--mount has {axis} = {value:g} m; valid: {low:g} to {high:g}")
    if not np.isfinite(request.turn_deg).all():
        raise ConfigError(f"--turn is {request.turn_deg}; give three finite angles in degrees")


def _settings(name: str, found: Anatomy) -> HandCfg:
    points = list(found.points)
    return HandCfg(
        name=name,
        points=points,
        fingertips=list(range(3, len(points), 3)),
        human_fingers=[finger.human for finger in found.fingers],
        gravity_compensation="all",
        num_base_joints=6,
        num_wrist_joints=len(found.wrist_joints),
        mean_fingers_rad=[],
        mount_body=models.MOUNT,
    )


def _scene(xml: str, found: Anatomy, plan: models.Plan, cfg: HandCfg) -> Scene:
    return _compiled(models.build(xml, found, plan), cfg)


def _compiled(root: ET.Element, cfg: HandCfg) -> Scene:
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise SceneError(f"hand '{cfg.name}' does not compile: {error}") from error
    return _quietly(bare_scene, spec, cfg)


def _quietly(function: Callable[..., R], *arguments: Any) -> R:
    """Call a function and suppress warnings, such as those of MuJoCo's mesh readers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(*arguments)


def _palm_normal(xml: str, found: Anatomy, plan: models.Plan, cfg: HandCfg) -> np.ndarray:
    """Return the direction (3,) in which the palm faces and fingers bend, in the file's frame."""
    scene = _scene(xml, found, plan, cfg)  # with the file's axes as the world's
    flexion = Flexion(scene)
    qpos = np.zeros(scene.model.nq)
    qpos[: scene.index.num_joints] = straight(scene)
    return flexion.palm(qpos)[1]


def _mounted(
    found: Anatomy, normal: np.ndarray, turn_deg: tuple[float, float, float]
) -> tuple[np.ndarray, str]:
    """Return the hand's orientation (3, 3) and its side.

    Without ``turn_deg``, fingers point forward and the palm faces down. If the fingers point along
    f and the palm faces n, a right hand has its little finger in the direction n x f, a left hand
    in the opposite one.
    """
    along = found.along
    facing = normal - along * (along @ normal)
    if np.linalg.norm(facing) < 0.1:
        raise ConfigError(
            "no direction was found in which the fingers bend; check the joints' axes and ranges"
        )
    facing /= np.linalg.norm(facing)
    right = np.cross(facing, along)
    own_axes = np.stack((right, along, -facing), axis=1)
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    # World axes: the little finger of a right hand is at +x, with fingers at +y and the palm down.
    return turn @ own_axes.T, "right" if right @ found.across > 0 else "left"


def _other_side(label: str, xml: str, side: str) -> str | None:
    """Return a note if the names of file and model state only the other side, otherwise None."""
    model = ET.fromstring(xml).get("model", "")
    other = "left" if side == "right" else "right"
    words = f"{label} {model}".lower()
    if other in words and side not in words:
        return (
            f"the file's names say {other} hand, but its fingers are arranged as in a {side} hand"
        )
    return None


def _mean(scene: Scene) -> np.ndarray:
    """Return the mean hand, (n,) m and rad: each closing joint :data:`MEAN_SHARE` of the way."""
    flexion, joints = Flexion(scene), straight(scene)
    fingers = joints[flexion.first :]
    closing = np.where(np.isnan(flexion.closed), fingers, flexion.closed)
    joints[flexion.first :] += MEAN_SHARE * (closing - fingers)
    return scene.index.couplings.apply(joints)


def _store(
    request: HandRequest,
    root: ET.Element,
    cfg: HandCfg,
    source: HandFile,
    notes: list[str],
    side: str,
    found: Anatomy,
) -> Path:
    """Store the model in the library source ``own``, and the settings in the user's folder."""
    facts: dict[str, Any] = {
        "file": request.file.name,
        "sha256": manifest.sha256_of(request.file),
        "kind": source.kind,
        "side": side,
        "fingers": {f.human: len(f.joints) for f in found.fingers},
        "fingers_found_by": found.found_by,
        "mimics": source.mimics,
        "reset": dict(request.reset),
        "kp": request.kp,
        "mount_m": list(request.place),
        "turn_deg": list(request.turn_deg),
        "notes": notes,
    }

    def make(folder: Path) -> list[str]:
        note = f"Made by pgdm from {request.file.name} ({request.licence}); do not edit."
        model_file.write(root, folder / "hand.xml", note)
        text = json.dumps(facts, indent=1) + "\n"
        (folder / "hand.json").write_text(text, encoding="utf-8")
        return notes

    path = settings_path(request.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = settings_text(cfg, request.file.name, side)
    is_new = request.name not in own.read().hands
    folder = own.add_model("hands", request.name, make, request.file.name, request.licence)
    try:
        with paths.replacing(path) as temp:
            temp.write_text(text, encoding="utf-8")
    except OSError:
        if is_new:
            own.remove(request.name)
        raise
    return folder
