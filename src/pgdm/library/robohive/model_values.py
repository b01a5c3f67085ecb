"""Values by which TCDM's models differ from those in the package ``robohive``.

TCDM is the paper authors' repository. Both sets of models derive from the same sources
(``vikashplus/object_sim``, ``Adroit``, ...). The package has the meshes, body trees and geoms;
these values turn them into the benchmark's models. All were taken from the compiled models of a
TCDM checkout with :mod:`pgdm.library.checks.compare`. :mod:`pgdm.library.robohive.hand_values` has
the values of D'Hand and D'Manus. Lengths in m, angles in rad, masses in kg, gains in N/m and
Nm/rad.
"""

from __future__ import annotations

BASE_JOINTS = (
    ("ARTx", "slide", "1 0 0", "-0.25 0.25"),
    ("ARTy", "slide", "0 1 0", "-0.2 0.1"),
    ("ARTz", "slide", "0 0 1", "-0.3 0.5"),
    ("ARRx", "hinge", "1 0 0", "-1.75 1.75"),
    ("ARRy", "hinge", "0 1 0", "-1.75 1.75"),
    ("ARRz", "hinge", "0 0 1", "-2.5 2.5"),
)
"""The six base joints of a hand: name, type, axis, range of joint and control."""

BASE_DAMPING = "20"
"""Damping of the base joints."""

HULL_OBJECTS = frozenset({"duck"})
"""Objects whose collision geom is the hull of the visual mesh, not the package's convex parts."""

YCB_OBJECTS: dict[str, dict[str, dict[str, str]]] = {
    "crackerbox": {
        "mesh": {"name": "003_cracker_box"},
        "visual": {"pos": "0.014 0.014 0.002"},
        "contact": {
            "type": "box",
            "size": "0.033 0.08 0.105",
            "pos": "0 0 0.105",
            "mass": "0.1453",
        },
    },
    "coffeecan": {
        "mesh": {"name": "002_master_chef_can"},
        "visual": {"pos": "0.014 0.014 0"},
        "contact": {
            "type": "cylinder",
            "size": "0.05 0.07",
            "pos": "-0.003 0.004 0.07",
            "mass": "0.414",
        },
    },
}
"""The two YCB objects: mesh, its position, and the colliding primitive with its measured mass."""

ADROIT_MOUNT = {"pos": "0 -0.7 0.2", "euler": "-1.57 0 3.14"}
"""Pose of Adroit's first body, the forearm, in the world."""

ADROIT_FOREARM = {"size": "0.05 0.033", "pos": "0 0 0.29", "type": "capsule"}
"""Contact geom of the forearm, for which the package uses the hull of its mesh."""

ADROIT_SOLID = frozenset({"V_thbase", "V_thhub"})
"""Two boxes of 2 mm inside the thumb that collide in TCDM and are only visual in the package."""

ADROIT_BASE_GAINS = {"T": "175", "R": "150"}
"""Gains of the base actuators: slides and hinges."""

ADROIT_WRIST_GAIN, ADROIT_FINGER_GAIN = "5", "1"
"""Gains of the wrist's and of the fingers' actuators; the package has 50 and 10."""

ADROIT_CONTROL_RANGES = {"A_WRJ1": "-0.524 0.175"}
"""Control ranges that the package rounds to two digits."""

ADROIT_POINTS: dict[str, tuple[str, str, str]] = {
    "palm": ("wrist_point", "0 0 0", "0.018"),
    **{
        f"{finger}{part}": (f"{finger}{point}_point", place, size)
        for finger in ("ff", "mf", "rf", "lf")
        for part, point, place, size in (
            ("knuckle", "knuckle", "0 0 0", "0.013"),
            ("middle", "middle", "0 0 0", "0.01"),
            ("distal", "distal", "0 0 0.01", "0.01"),
        )
    },
    "thbase": ("thknuckle_point", "0 0 0", "0.017"),
    "thmiddle": ("thmiddle_point", "0 0 0", "0.012"),
    "thdistal": ("thdistal_point", "0 0 0.01", "0.0115"),
}
"""Tracked points by carrying body: name, position in that body, radius of the sphere.

The spheres do not collide, but each is a separate body whose mass follows from its volume."""

_SKEWED = "-0.33141357403559174 -0.1913417161825449 0.4619397662556433 0.8001031451912656"
_FROM_THE_SIDE = "0.6532814824381883 0.27059805007309845 0.2705980500730985 0.6532814824381882"
CAMERAS = (
    ("skew_side", "-0.6 0.7 0.8", _SKEWED, "60"),
    ("paper", "-0.6 0.6 0.6", _SKEWED, "20"),
    ("side", "0.75 0 0.8", _FROM_THE_SIDE, "50"),
    ("vil_camera", "0 -1.2 1.2", "0.92388 -0.382683 0 0", "25"),
)
"""Cameras of the scene: name, position, quaternion wxyz, field of view in degrees."""
