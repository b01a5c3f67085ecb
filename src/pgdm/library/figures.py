"""The figures by which TCDM's models differ from those in the package ``robohive``.

Both come from the same simulators (``vikashplus/object_sim``, ``Adroit``, ...). The package brings
meshes, body trees and geoms; the numbers here bring them to what the benchmark's environment has.
Every figure was read off the compiled models of a TCDM checkout with :mod:`pgdm.library.compare`.
Lengths in m, angles in rad, masses in kg, gains in N/m and Nm/rad.
"""

from __future__ import annotations

_GRAB_TASKS = (
    "airplane-fly1 airplane-pass1 alarmclock-lift alarmclock-see1 banana-pass1 binoculars-pass1 "
    "cup-drink1 cup-pour1 duck-inspect1 duck-lift elephant-pass1 eyeglasses-pass1 flashlight-lift "
    "flashlight-on2 flute-pass1 fryingpan-cook2 hammer-use1 hand-inspect1 headphones-pass1 "
    "knife-chop1 lightbulb-pass1 mouse-lift mouse-use1 mug-drink3 piggybank-use1 scissors-use1 "
    "spheremedium-lift stamp-stamp1 stanfordbunny-inspect1 stapler-lift toothbrush-lift "
    "toothpaste-lift toruslarge-inspect1 train-play1 watch-lift waterbottle-lift "
    "waterbottle-shake1 wineglass-drink1 wineglass-drink2 wineglass-toast1"
)
GRAB_TASKS = tuple(_GRAB_TASKS.split())
"""The motion-capture tasks, which the package can serve."""

_OTHER_TASKS = (
    "dhand-alarmclock dhand-binoculars dhand-cup dhand-elephant dhand-waterbottle "
    "dmanus-coffeecan dmanus-crackerbox dmanus-sim2real door-open hammer-strike "
    "spheremedium-relocate"
)
OTHER_TASKS = tuple(_OTHER_TASKS.split())
"""Tasks of the benchmark that only a TCDM checkout has."""

SUBSTEPS = 10
"""Physics steps per control step of every task."""

BASE_JOINTS = (
    ("ARTx", "slide", "1 0 0", "-0.25 0.25"),
    ("ARTy", "slide", "0 1 0", "-0.2 0.1"),
    ("ARTz", "slide", "0 0 1", "-0.3 0.5"),
    ("ARRx", "hinge", "1 0 0", "-1.75 1.75"),
    ("ARRy", "hinge", "0 1 0", "-1.75 1.75"),
    ("ARRz", "hinge", "0 0 1", "-2.5 2.5"),
)
"""The six joints that place a hand: name, type, axis, range (which is the control range too)."""

BASE_DAMPING = "20"
"""Damping of the base joints."""

COMMON_DEFAULTS: dict[str, dict[str, str]] = {
    "joint": {
        "limited": "true",
        "margin": "0.01",
        "armature": "0.001",
        "damping": "0.05",
        "frictionloss": "0.001",
    },
    "geom": {"friction": "1 0.5 0.01", "margin": "0.0005", "density": "1250"},
    "site": {"size": "0.005 0 0", "rgba": "0.4 0.9 0.4 1"},
    "general": {"ctrllimited": "true", "ctrlrange": "-1 1"},
    "tendon": {"limited": "true"},
}
"""Defaults of objects, Adroit and the table scene; D'Hand and D'Manus have MuJoCo's own."""

OBJECT_CLASSES: dict[str, tuple[str, dict[str, str]]] = {
    "object_visual": (
        "geom",
        {
            "type": "mesh",
            "contype": "0",
            "conaffinity": "0",
            "mass": "0",
            "group": "1",
            "material": "MatObject",
        },
    ),
    "object_contact": ("geom", {"type": "mesh", "density": "1250", "condim": "4"}),
    "freejoint": ("joint", {"limited": "false", "damping": "0"}),
}
"""Default classes of the objects' geoms and joints."""

OBJECT_MATERIAL = {
    "name": "MatObject",
    "specular": "0.75",
    "shininess": "0.1",
    "reflectance": "0.5",
    "rgba": "0.9 0.7 0.5 1",
}
"""Look of the objects."""

OBJECT_HEIGHT = 0.035
"""Height of an object body's zero position before the scene places it."""

HULL_OBJECTS = frozenset({"duck"})
"""Objects that touch with the hull of their visual mesh, not with the package's convex parts."""

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
"""The two YCB objects: mesh, its place, and the primitive that touches, with measured mass."""

ADROIT_MOUNT = {"pos": "0 -0.7 0.2", "euler": "-1.57 0 3.14"}
"""Place of Adroit's forearm."""

ADROIT_FOREARM = {"size": "0.05 0.033", "pos": "0 0 0.29", "type": "capsule"}
"""Contact geom of the forearm; the package has the hull of its mesh."""

ADROIT_SOLID = frozenset({"V_thbase", "V_thhub"})
"""Two boxes of 2 mm inside the thumb that touch things in TCDM, and only show in the package."""

ADROIT_BASE_GAINS = {"T": "175", "R": "150"}
"""Gains of the sliding and turning base actuators."""

ADROIT_WRIST_GAIN, ADROIT_FINGER_GAIN = "5", "1"
"""Gains of the other actuators; the package has 50 and 10."""

ADROIT_CONTROL_RANGES = {"A_WRJ1": "-0.524 0.175"}
"""Control ranges that differ; the package has two digits."""

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
"""The tracked points: by the body that carries them, name, place in it, radius of the sphere.

The spheres touch nothing, but each is a body of its own with the mass of its volume."""

CAMERAS = (
    (
        "skew_side",
        "-0.6 0.7 0.8",
        "-0.33141357403559174 -0.1913417161825449 0.4619397662556433 0.8001031451912656",
        "60",
    ),
    (
        "paper",
        "-0.6 0.6 0.6",
        "-0.33141357403559174 -0.1913417161825449 0.4619397662556433 0.8001031451912656",
        "20",
    ),
    (
        "side",
        "0.75 0 0.8",
        "0.6532814824381883 0.27059805007309845 0.2705980500730985 0.6532814824381882",
        "50",
    ),
    ("vil_camera", "0 -1.2 1.2", "0.92388 -0.382683 0 0", "25"),
)
"""Cameras of the scene: name, position, quaternion wxyz, field of view in degrees."""
