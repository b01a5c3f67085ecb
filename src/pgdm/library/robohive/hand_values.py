"""Values by which TCDM's D'Hand and D'Manus differ from those in the package ``robohive``.

:mod:`pgdm.library.robohive.model_values` has the units and says how the values were obtained.
"""

from __future__ import annotations

HIGH_BASE_RANGES = {"ARTz": "-0.1 0.7"}
"""Base joint ranges of D'Hand and D'Manus that differ from Adroit's; their control
ranges do not."""

DHAND_MOUNT = {"pos": "0 -0.7 0.2", "euler": "1.57 3.14 0"}
"""Pose of D'Hand's first body, the wrist, in the world."""

DHAND_BASE_GAINS = {"T": "175", "R": "150"}
"""Gains of D'Hand's base actuators."""

DHAND_FINGERS = ("FF", "MF", "PF", "TF")
"""Fingers of D'Hand, the thumb last."""

DHAND_SHOWN: dict[str, tuple[int, ...]] = {
    "palm": (8,),
    "TF_metacarpel": (3,),
    **{f"{finger}_metacarpel": (2, 3, 4) for finger in ("FF", "MF", "PF")},
    **{
        f"{finger}_{part}": (3, 4)
        for finger in DHAND_FINGERS
        for part in ("proximal", "middle", "distal")
        if (finger, part) != ("TF", "proximal")
    },
}
"""Geoms of D'Hand, by body and index, that collide in the package and are only visual in TCDM."""

DHAND_NAMES: dict[str, dict[int, str]] = {
    "palm": {6: "palm_1", 7: "palm_2", 11: "palm_3", 12: "palm_4", 14: "palm_5", 16: "palm_6"},
    "TF": {5: "TF_metacarpel"},
    "TF_metacarpel": {3: "TF_middle"},
    "TF_middle": {5: "TF_distal"},
    "TF_distal": {5: "TF_tip"},
    **{
        f"{finger}_{part}": {5: f"{finger}_{name}"}
        for finger in ("FF", "MF", "PF")
        for part, name in (
            ("metacarpel", "proximal"),
            ("proximal", "middle"),
            ("middle", "distal"),
            ("distal", "tip"),
        )
    },
}
"""Names given to D'Hand's geoms for the contact pairs, by body and index."""

DHAND_POINTS: dict[str, tuple[str, str]] = {
    "wrist-adb": ("wrist_point", "0 0 0"),
    "palm": ("palm_point", "0 0 0"),
    "TF": ("tfknuckle_point", "0 0 0"),
    **{
        f"{finger}_metacarpel": (f"{finger.lower()}knuckle_point", "0 0 0")
        for finger in ("FF", "MF", "PF")
    },
    **{
        f"{finger}_{part}": (f"{finger.lower()}{part}_point", place)
        for finger in DHAND_FINGERS
        for part, place in (("middle", "0 0 0"), ("distal", "0 0 0.045"))
    },
}
"""D'Hand's tracked points by carrying body: name, position of the sphere in that body."""

DHAND_CLASSES: dict[str, dict[str, str]] = {
    "vis_metal": {"group": "5"},
    "phys_metal": {"contype": "1", "condim": "4", "margin": "0.001", "group": "4"},
}
"""Contact settings of D'Hand's geoms. ``phys_metal`` geoms collide in contact pairs and with geoms
whose ``conaffinity`` allows it."""

POINT_CLASS = {
    "type": "sphere",
    "size": "0.03",
    "mass": "0",
    "contype": "0",
    "conaffinity": "0",
    "rgba": "1 0 0 0",
}
"""Spheres of the tracked points of D'Hand and D'Manus."""

DMANUS_MOUNT = {"pos": "0 -0.7 0.2", "euler": "-1.57 0 3.14"}
"""Pose of D'Manus' stand, its first body, in the world."""

DMANUS_PALM = "0 0 0.09125"
"""Position of D'Manus' palm in the stand's frame."""

DMANUS_BASE_GAINS = {"T": "50", "R": "25"}
"""Gains of D'Manus' base actuators."""

DMANUS_GAIN, DMANUS_DAMPING, DMANUS_ARMATURE = "10", "1", "0.001"
"""Gain of D'Manus' finger and thumb actuators, damping and armature of their joints; the package
has 100, 5 and 0."""

DMANUS_RANGES = {
    "TFJ1": "-0.75 0.57",
    "TFJ2": "0 1.89",
    "TFJ2e": "0 1.40",
    "TFJ3": "0.0 1.57",
    "IFJ1": "-0.436 0.436",
    "IFJ2": "0.0 1.71",
    "IFJ3": "0.0 1.52",
    "LFJ1": "-0.52 0.35",
    "LFJ2": "0.0 1.54",
    "LFJ3": "0.0 1.48",
}
"""Ranges of D'Manus' finger and thumb joints and of their controls, in the actuators' order.
``TFJ2e`` moves the thumb's second middle link, a copy of the first that only TCDM's hand has."""

DMANUS_POINTS: dict[str, tuple[str, str]] = {
    "palm": ("wrist_point", "0 0 0"),
    "thumb_proximal": ("thknuckle_point", "0 0 0"),
    "thumb_middle_extra": ("thmiddle_point", "0 0 0"),
    "thumb_distal": ("thdistal_point", "0 0 0.075"),
    **{
        f"{finger}_{part}": (f"{short}{point}_point", place)
        for finger, short in (("index", "ff"), ("little", "rf"))
        for part, point, place in (
            ("proximal", "knuckle", "0 0 0.03"),
            ("middle", "middle", "0 0 0.075"),
            ("distal", "distal", "0 0 0.075"),
        )
    },
}
"""D'Manus' tracked points by carrying body: name, position of the sphere in that body."""

_DMANUS_LINKS = {
    # Geoms of thumb, index and little finger, the tip last, paired in this order.
    "T": "FR1232 X4309 FR1232e X4309e FR1312 convextip3",
    "I": "FR1210 X4302 FR1230 X4303 FR1310 convextip1",
    "L": "FR1211 X4305 FR1231 X4306 FR1311_mesh convextip2",
}
DMANUS_PAIRS: tuple[tuple[str, str], ...] = (
    *zip(_DMANUS_LINKS["T"].split(), _DMANUS_LINKS["I"].split(), strict=True),
    *zip(_DMANUS_LINKS["T"].split(), _DMANUS_LINKS["L"].split(), strict=True),
    ("convextip3", "FR1212"),
    ("convextip3", "X4308"),
    *zip(_DMANUS_LINKS["I"].split(), _DMANUS_LINKS["L"].split(), strict=True),
    *(
        (f"Palm{part}", f"convextip{tip}")
        for part in ("center", "right", "left1", "left2")
        for tip in (1, 2, 3)
    ),
)
"""Contact pairs of D'Manus. Two of them use a mesh that is otherwise only visual, as in TCDM."""
