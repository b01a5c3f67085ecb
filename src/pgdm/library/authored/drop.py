"""The drop test: does an object dropped onto the table come to rest there?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pgdm.errors import LibraryError
from pgdm.library.checks.compiled import compile_tracked
from pgdm.library.checks.lowest import lowest

HEIGHT_M = 0.005
"""Initial height of the object's lowest point above the table."""
TIME_S = 4.0  # duration of the simulation
SINK_M = 0.002
"""An object at rest is sunk less than this into the table; the contact margin is 0.5 mm."""
DRIFT_M = 0.03
"""An object at rest moves less than this horizontally in the second half of the simulation."""
REST_M_S, REST_RAD_S = 0.01, 0.1  # an object at rest is slower than this at the end
_TABLE = """<mujoco><option timestep="0.004" iterations="20" noslip_iterations="20"/>
<default><geom friction="1 0.5 0.01" margin="0.0005"/></default>
<worldbody><geom type="box" size="0.45 0.45 0.025" pos="0 0 -0.025"/></worldbody></mujoco>"""


@dataclass(frozen=True)
class Drop:
    """Final state of a dropped object."""

    qpos: np.ndarray  # (6,) joint positions, m and rad
    quat: np.ndarray  # (4,) wxyz, orientation, world frame
    com: np.ndarray  # (3,) m, centre of mass, world frame
    turned_rad: float
    """Angle of the rotation from the initial orientation."""
    sunk_m: float
    """Depth of its lowest point below the table top, at least 0."""
    drift_m: float
    """Horizontal displacement of its centre of mass in the second half of the simulation."""
    speed_m_s: float  # of the centre of mass
    turn_rad_s: float  # angular speed

    @property
    def rests(self) -> bool:
        """Whether it is at rest on the table: slow, not sunk in, not drifting (limits above)."""
        still = self.speed_m_s < REST_M_S and self.turn_rad_s < REST_RAD_S
        return still and self.sunk_m < SINK_M and self.drift_m < DRIFT_M


def drop(
    object_xml: Path, place: tuple[float, float] = (0.0, 0.0), turn: Rotation | None = None
) -> Drop:
    """Drop an object from a few millimetres above the table.

    Args:
        object_xml: MJCF of the object.
        place: initial horizontal position of the centre of mass, (x, y) m.
        turn: initial orientation; None: as in the model.

    Raises:
        LibraryError: the simulation diverges.
    """
    spec = mujoco.MjSpec.from_string(_TABLE)
    spec.attach(
        mujoco.MjSpec.from_file(str(object_xml)), prefix="it/", frame=spec.worldbody.add_frame()
    )
    spec.body("it/object").pos = (0.0, 0.0, 0.0)
    model = compile_tracked(spec, "it/object")
    data = mujoco.MjData(model)
    body = model.body("it/object").id
    start = Rotation.identity() if turn is None else turn
    data.qpos[3:] = start.as_euler("XYZ")
    data.qpos[:2] = np.array(place) - start.apply(model.body_ipos[body])[:2]
    data.qpos[2] = HEIGHT_M - lowest(model, data, body)
    half = np.zeros(3)
    steps = round(TIME_S / model.opt.timestep)
    for step in range(steps):
        mujoco.mj_step(model, data)
        if step == steps // 2:
            half = data.xipos[body].copy()
    if data.warning.number.any() or not np.isfinite(data.qpos).all():
        raise LibraryError(f"{object_xml.parent.name}: the simulation of its fall diverges")
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    end = data.xipos[body]
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
    return Drop(
        qpos=data.qpos.copy(),
        quat=data.xquat[body].copy(),
        turned_rad=_turned(start, data.xquat[body]),
        com=end.copy(),
        sunk_m=max(0.0, -lowest(model, data, body)),
        drift_m=float(np.linalg.norm(end[:2] - half[:2])),
        speed_m_s=float(np.linalg.norm(velocity[3:])),
        turn_rad_s=float(np.linalg.norm(velocity[:3])),
    )


def _turned(start: Rotation, quat: np.ndarray) -> float:
    return float((start.inv() * Rotation.from_quat(quat, scalar_first=True)).magnitude())
