"""Small checkouts of our own in TCDM's layout, for tests that must not need the real one."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

STEPS = 6
JOINTS = {"adroit": 2, "dhand": 1, "dmanus": 1}
"""Joints of the hands below; the objects have one."""

_COMMON = """<mujoco><compiler angle="radian"/>
<asset><material name="MatObject" rgba="1 0 0 1"/></asset>
<default><joint damping="0.05"/>
<default class="object_contact"><geom type="mesh" density="1250"/></default></default></mujoco>"""

_TABLE = """<mujoco model="table-environment"><include file="../common.xml"/>
<option timestep="0.004"/><size njmax="1000" nconmax="100" nstack="600000"/>
<worldbody><body name="table"><geom name="table_contact" type="box" size=".4 .4 .02"/></body>
</worldbody></mujoco>"""

_ADROIT = """<mujoco model="adroit"><include file="../../common.xml"/><worldbody>
<body name="forearm" euler="-1.57 0 3.14"><geom size=".1"/><joint name="ARTx" type="slide"/>
<body name="palm"><geom size=".05"/><joint name="WRJ0"/></body></body></worldbody></mujoco>"""

_ADROIT_MOTORS = """<mujoco model="adroit"><actuator>
<position name="A_ARTx" joint="ARTx" ctrllimited="true" ctrlrange="-1 1" kp="175"/>
<position name="A_WRJ0" joint="WRJ0" ctrllimited="true" ctrlrange="-1 1" kp="5"/>
</actuator></mujoco>"""

_OTHER = """<mujoco model="{name}"><compiler angle="radian" meshdir="."/><worldbody>
<body name="stand" euler="1.57 0 0"><geom size=".1" euler="{euler}"/>
<joint name="ARTx" type="slide"/></body></worldbody></mujoco>"""

_OTHER_MOTORS = """<mujoco><actuator>
<position name="A" joint="ARTx" ctrlrange="-1 1" ctrllimited="true" kp="50"/></actuator></mujoco>"""

_OBJECT = """<mujoco model="{name}"><include file="../common.xml"/><asset>
<mesh name="contact0" file="../meshes/objects/{name}/contact0.stl"/></asset>
<worldbody><body name="object"><joint name="OBJTz" type="slide" axis="0 0 1"/>
<geom name="{name}_contact0" class="object_contact" mesh="contact0"/></body></worldbody></mujoco>"""


def make_checkout(root: Path, tasks: tuple[str, ...] = ("hammer_use1",)) -> Path:
    """Write a checkout with three hands, the objects ``hammer`` and ``cup``, and some tasks."""
    assets = root / "tcdm" / "envs" / "assets"
    files = {
        "common.xml": _COMMON,
        "environments/table.xml": _TABLE,
        "robots/adroit/base.xml": _ADROIT,
        "robots/adroit/actuators.xml": _ADROIT_MOTORS,
        "robots/dhand/base.xml": _OTHER.format(name="dhand", euler="0.1 0 0"),
        "robots/dhand/actuators.xml": _OTHER_MOTORS,
        "robots/dmanus/base.xml": _OTHER.format(name="dmanus", euler="0.114 0 0w"),
        "robots/dmanus/actuators.xml": _OTHER_MOTORS,
        "objects/hammer.xml": _OBJECT.format(name="hammer"),
        "objects/cup.xml": _OBJECT.format(name="cup"),
        "meshes/objects/LICENSE": "Apache License",
    }
    for name, text in files.items():
        path = assets / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for name in ("hammer", "cup"):
        write_tetrahedron(assets / "meshes" / "objects" / name / "contact0.stl")
    (root / "trajectories").mkdir()
    for task in tasks:
        write_trajectory(root / "trajectories" / f"{task}.npz")
    return root


def write_tetrahedron(path: Path) -> None:
    """Write a binary STL of a tetrahedron, 10 cm."""
    corners = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    data = bytes(80) + struct.pack("<I", len(faces))
    for face in faces:
        numbers = [0.0, 0.0, 0.0, *(x for i in face for x in corners[i])]
        data += struct.pack("<12fH", *numbers, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def trajectory(hand: str = "adroit", **changes: Any) -> dict[str, Any]:
    """Return the arrays of a TCDM trajectory; ``changes`` replaces some, None leaves one out."""
    joints = JOINTS[hand] + 1
    quaternions = np.zeros((STEPS, 4))
    quaternions[:, 0] = 1.0
    arrays: dict[str, Any] = {
        "object_translation": np.linspace(0.0, 0.1, STEPS)[:, None] * [0.0, 0.0, 1.0],
        "object_orientation": quaternions,
        "length": STEPS,
        "SIM_SUBSTEPS": 10,
        "DATA_SUBSTEPS": 1,
        "s_0": {
            "initialized": {"position": np.zeros(joints), "velocity": np.zeros(joints)},
            "motion_planned": {
                "position": np.full(joints, 0.1),
                "velocity": np.full(joints, 0.1),
                "actions": np.zeros((4, JOINTS[hand]), np.float32),
            },
        },
    }
    arrays.update(changes)
    return {key: value for key, value in arrays.items() if value is not None}


def write_trajectory(path: Path, arrays: dict[str, Any] | None = None) -> Path:
    """Write a trajectory file as TCDM has them: ``s_0`` is a pickled object array."""
    hand = path.stem.split("_")[0]
    filled = trajectory(hand if hand in JOINTS else "adroit") if arrays is None else arrays
    np.savez(path, **filled)
    return path


def snapshot(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder with its content."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }
