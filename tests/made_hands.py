"""Small hands of boxes and capsules, as MJCF and as URDF: fingers along z, the palm faces x."""

from __future__ import annotations

from pathlib import Path

FINGERS = ("index", "middle", "ring", "thumb")
_Y = {"index": 0.03, "middle": 0.01, "ring": -0.01, "little": -0.03}
LENGTHS = (0.045, 0.035, 0.03)
"""Lengths of the links of a finger, m."""


def finger_frame(name: str, side: str) -> tuple[str, str, tuple[int, int, int]]:
    """Return position and URDF angles of a finger's base, and the axis about which it bends."""
    sign = 1 if side == "right" else -1
    if name == "thumb":  # its own z axis points to the thumb's side; it bends towards x
        return f"0.02 {0.045 * sign} 0.03", f"{-1.5707963 * sign} 0 0", (0, 1, 0)
    return f"0 {sign * _Y[name]} 0.09", "0 0 0", (0, 1, 0)


def urdf(
    fingers: tuple[str, ...] = FINGERS,
    side: str = "right",
    mimic: bool = False,
    thumb_low: float = 0.0,
    names: dict[str, str] | None = None,
    mass: float = 0.4,
) -> str:
    """Return a URDF hand of 3 joints a finger; with ``mimic`` the last follows: 0.1 + 0.8 q."""
    parts = [
        f'<robot name="{side}_made"><link name="palm"><inertial><mass value="{mass}"/>'
        '<origin xyz="0 0 .045"/><inertia ixx="3e-4" iyy="3e-4" izz="3e-4" ixy="0" ixz="0" '
        'iyz="0"/></inertial><collision><origin xyz="0 0 .045"/><geometry>'
        '<box size=".02 .08 .09"/></geometry></collision></link>'
    ]
    for finger in fingers:
        name = (names or {}).get(finger, finger)
        place, turn, axis = finger_frame(finger, side)
        before, low = "palm", thumb_low if finger == "thumb" else -0.1
        for k, length in enumerate(LENGTHS):
            follows = mimic and k == 2
            span = (-0.1, 1.6) if follows else (low if k == 0 else -0.1, 1.6)
            parts.append(
                f'<link name="{name}_{k}"><inertial><mass value=".03"/>'
                f'<origin xyz="0 0 {length / 2}"/><inertia ixx="5e-6" iyy="5e-6" izz="2e-6" '
                'ixy="0" ixz="0" iyz="0"/></inertial>'
                f'<collision><origin xyz="0 0 {length / 2}"/><geometry>'
                f'<box size=".014 .014 {length - 0.002}"/></geometry></collision></link>'
                f'<joint name="{name}_j{k}" type="revolute"><parent link="{before}"/>'
                f'<child link="{name}_{k}"/><origin xyz="{place}" rpy="{turn}"/>'
                f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
                f'<limit lower="{span[0]}" upper="{span[1]}" effort="2" velocity="3"/>'
                + (f'<mimic joint="{name}_j1" multiplier=".8" offset=".1"/>' if follows else "")
                + "</joint>"
            )
            before, place, turn = f"{name}_{k}", f"0 0 {length}", "0 0 0"
    return "\n".join([*parts, "</robot>"])


def mjcf(fingers: tuple[str, ...] = FINGERS, side: str = "right", extra: str = "") -> str:
    """Return an MJCF hand in degrees, with position servos of kp 2 and a passive tendon."""
    bodies, servos = [], []
    for finger in fingers:
        place, turn, axis = finger_frame(finger, side)
        angle = "euler" if turn != "0 0 0" else ""
        degrees = f'{angle}="{-90 if side == "right" else 90} 0 0"' if angle else ""
        text = close = ""
        for k, length in enumerate(LENGTHS):
            text += (
                f'<body name="{finger}_{k}" pos="{place}" {degrees if k == 0 else ""}>'
                f'<joint name="{finger}_j{k}" axis="{axis[0]} {axis[1]} {axis[2]}" range="-6 90"/>'
                f'<geom type="box" size=".007 .007 {length / 2 - 0.001}" pos="0 0 {length / 2}" '
                'density="3000"/>'
            )
            close += "</body>"
            place = f"0 0 {length}"
            servos.append(
                f'<position name="{finger}_a{k}" joint="{finger}_j{k}" kp="2" kv=".05" '
                'ctrlrange="-.08 1.4"/>'
            )
        bodies.append(text + close)
    return f"""<mujoco model="made"><compiler angle="degree"/><option timestep="0.001"/>
<default><joint damping=".02" limited="true"/></default>
<worldbody><light pos="0 0 1"/><geom name="floor" type="plane" size="1 1 .1"/>
<body name="palm" pos=".1 .2 .3"><geom type="box" size=".01 .04 .045" pos="0 0 .045" density="800"/>
{"".join(bodies)}</body></worldbody>
<tendon><fixed name="passive"><joint joint="index_j0" coef="1"/></fixed></tendon>
<actuator>{"".join(servos)}</actuator>{extra}
<keyframe><key name="home" qpos="{"0 " * 3 * len(fingers)}"/></keyframe></mujoco>"""


def saved(text: str, name: str = "hand.urdf") -> Path:
    """Write a file into the working directory."""
    path = Path(name)
    path.write_text(text)
    return path
