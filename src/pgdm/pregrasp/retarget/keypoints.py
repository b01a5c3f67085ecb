"""Keypoints: the checked joints of a human right hand, which inverse kinematics follows.

A file's points, in metres, have one of two orders. ``mano``: wrist, then index, middle, little,
ring finger and thumb with three joints each from the palm outwards (16 points), optionally followed
by the tips of thumb, index, middle, ring and little finger (21). ``openpose``: wrist, then thumb,
index, middle, ring and little finger with three joints and a tip each (21).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pgdm.errors import ConfigError, check_name
from pgdm.pregrasp.hand_geometry import unit

FINGERS = ("index", "middle", "little", "ring", "thumb")
"""Fingers in the order of all arrays here, which is MANO's."""

ORDERS = ("mano", "openpose")
"""Orders of points that a file may have."""

TIP_M = 0.02
"""If no tip is given, the last bone extends the bone before it by this length."""

_OPENPOSE_FINGERS = ("thumb", "index", "middle", "ring", "little")
_JOINTS = ("knuckle", "middle", "distal", "tip")
_BONE_M = 0.005, 0.16
"""Shortest and longest plausible bone: an infant's fingertip, the largest palm."""
_SPAN_M = 0.05
"""Smallest plausible :attr:`Keypoints.span_m`: an infant's hand."""
_FLAT_M = 0.003
"""Measurement tolerance: how far the thumb of a right hand may lie behind the plane of the palm."""
_WORLD_M = 1e6
"""Coordinates of this size or larger are refused, whatever their unit."""
_MM, _CM = 1e-3, 1e-2


@dataclass(frozen=True)
class Keypoints:
    """The keypoints of a right hand, world frame, m; :meth:`of` creates and checks them."""

    wrist: np.ndarray = field(repr=False)
    """Position of the wrist (3,)."""
    fingers: np.ndarray = field(repr=False)
    """Knuckle, middle joint, distal joint and tip of each finger (5, 4, 3), in the order of
    :data:`FINGERS`; for the thumb, its three joints and its tip."""
    own: tuple[str, ...] = FINGERS
    """Fingers that were measured; the others are derived from their neighbours."""

    @classmethod
    def of(
        cls, points: np.ndarray, order: str | None = None, label: str = "keypoints"
    ) -> Keypoints:
        """Check the points of one hand and sort them by finger.

        Args:
            points: (16, 3) or (21, 3) m.
            order: one of :data:`ORDERS`; by default ``mano`` for 16 points, ``openpose`` for 21.
            label: name of the points in error messages.

        Raises:
            ConfigError: the number of points is wrong, the order is unknown or does not fit that
                number, a coordinate is not finite or its size is 1e6 or more, bone lengths are
                impossible (perhaps in another unit than metres), or the hand is a left one.
        """
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) not in (16, 21):
            raise ConfigError(
                f"{label}: {' x '.join(map(str, points.shape)) or 'one'} numbers are not a hand; "
                "expected 16 joints or 21 keypoints of x, y, z"
            )
        wrong = np.argwhere(~(np.abs(points) < _WORLD_M))  # NaN compares as false
        if len(wrong):
            row, axis = wrong[0]
            raise ConfigError(
                f"{label}: point {row} has {'xyz'[axis]} = {points[row, axis]}; coordinates must "
                f"be finite, and below {_WORLD_M:g} in size"
            )
        order = order or ("mano" if len(points) == 16 else "openpose")
        check_name(f"{label}: order of points", order, ORDERS)
        hand = cls(points[0], _sorted(points, order, label))
        hand.check(label)
        return hand

    @property
    def pads(self) -> np.ndarray:
        """The fingers' pads: middles of their last bones (5, 3), where fingers touch things."""
        return self.fingers[:, 2:].mean(axis=1)

    @property
    def joints(self) -> np.ndarray:
        """The 16 joints in MANO's order (16, 3)."""
        return np.concatenate((self.wrist[None], self.fingers[:, :3].reshape(15, 3)))

    @property
    def span_m(self) -> float:
        """Largest distance from the wrist to the pad of a measured finger, along the bones."""
        chain = np.concatenate(
            (np.broadcast_to(self.wrist, (5, 1, 3)), self.fingers[:, :2], self.pads[:, None]),
            axis=1,
        )
        own = [FINGERS.index(name) for name in self.own]
        return float(np.linalg.norm(np.diff(chain, axis=1), axis=-1).sum(axis=1)[own].max())

    def palm(self, fingers: Sequence[str] = ("index", "middle", "ring", "little")) -> np.ndarray:
        """Return the palm's axes as columns (3, 3): see :func:`palm_axes`.

        Args:
            fingers: fingers whose knuckles define the palm, starting at the thumb's side.
        """
        knuckles = self.fingers[[FINGERS.index(name) for name in fingers], 0]
        return palm_axes(self.wrist, knuckles)

    def moved(self, rotation: np.ndarray, translation: np.ndarray) -> Keypoints:
        """Return the hand rotated by (3, 3) about the origin, then translated by (3,) m."""
        transposed = rotation.T
        return Keypoints(
            self.wrist @ transposed + translation, self.fingers @ transposed + translation, self.own
        )

    def check(self, label: str) -> None:
        """Check that this is a right hand of human size.

        Raises:
            ConfigError: it is a left hand, or not of human size; ``label`` names it.
        """
        bones = _bones(self)
        typical = float(np.median(bones))
        for scale, name in ((_MM, "millimetres"), (_CM, "centimetres")):
            scaled = bones * scale
            fits = (scaled > _BONE_M[0]).all() and (scaled < _BONE_M[1]).all()
            if typical > _BONE_M[1] and fits:
                raise ConfigError(
                    f"{label}: the median bone is {typical:.3g} long: these look like {name}, but "
                    "points must be in metres"
                )
        wrong = np.argwhere((bones < _BONE_M[0]) | (bones > _BONE_M[1]))
        if len(wrong):
            finger, bone = wrong[0]
            begin = "wrist" if bone == 0 else _JOINTS[bone - 1]
            raise ConfigError(
                f"{label}: {FINGERS[finger]}, {begin} to {_JOINTS[bone]}: "
                f"{bones[finger, bone]:.3g} m, but bones are {_BONE_M[0]} to {_BONE_M[1]} m long"
            )
        if self.span_m < _SPAN_M:
            raise ConfigError(
                f"{label}: {self.span_m:.3g} m from wrist to pads is too short for a hand"
            )
        # In any pose the thumb's joints lie on the palmar side of the palm's plane.
        palmar = float(((self.fingers[4, :3] - self.wrist) @ -self.palm()[:, 2]).mean())
        if palmar < -_FLAT_M:
            raise ConfigError(
                f"{label}: the thumb lies {-1e3 * palmar:.0f} mm behind the back of a right hand: "
                "this is a left hand (mirror it), or has another order of points (set 'order')"
            )


def palm_axes(wrist: np.ndarray, knuckles: np.ndarray) -> np.ndarray:
    """Return the axes of a right hand's palm as columns (3, 3), a rotation.

    x points from the first to the last knuckle, y from the wrist to the knuckles, z out of the back
    of the hand.

    Args:
        wrist: (3,) m.
        knuckles: knuckles of two or more fingers, starting at the thumb's side (K, 3) m.
    """
    y = unit(knuckles.mean(axis=0) - wrist)
    across = knuckles[-1] - knuckles[0]
    x = unit(across - y * (across @ y))
    return np.stack((x, y, np.cross(x, y)), axis=1)


def filled(wrist: np.ndarray, known: dict[str, np.ndarray]) -> Keypoints:
    """Return a hand from some known fingers; the other fingers are filled in.

    An unknown finger is interpolated or extrapolated from the two nearest known ones; an unknown
    thumb is a copy of the index finger.

    Args:
        wrist: (3,) m.
        known: knuckle, middle joint, distal joint and tip (4, 3) m, by name of the finger.

    Raises:
        ConfigError: fewer than two fingers besides the thumb are known, or a name is unknown.
    """
    for name in known:
        check_name("finger", name, FINGERS)
    row = ("index", "middle", "ring", "little")
    have = [i for i, name in enumerate(row) if name in known]
    if len(have) < 2:
        raise ConfigError(
            f"a hand needs two fingers besides the thumb, but has {', '.join(known) or 'none'}"
        )
    fingers = dict(known)
    for i, name in enumerate(row):
        if name not in fingers:
            a, b = sorted(sorted(have, key=lambda k: abs(k - i))[:2])
            first, second = known[row[a]], known[row[b]]
            fingers[name] = first + (second - first) * ((i - a) / (b - a))
    if "thumb" not in fingers:
        fingers["thumb"] = fingers["index"].copy()
    own = tuple(name for name in FINGERS if name in known)
    return Keypoints(wrist, np.stack([fingers[name] for name in FINGERS]), own)


def _sorted(points: np.ndarray, order: str, label: str) -> np.ndarray:
    """Return the fingers (5, 4, 3), in the order of :data:`FINGERS`, of points (16|21, 3)."""
    if order == "openpose":
        if len(points) != 21:
            raise ConfigError(f"{label}: order openpose has 21 points, not {len(points)}")
        chains = points[1:].reshape(5, 4, 3)
        return chains[[_OPENPOSE_FINGERS.index(name) for name in FINGERS]]
    joints = points[1:16].reshape(5, 3, 3)
    if len(points) == 21:
        tips = points[16:][[_OPENPOSE_FINGERS.index(name) for name in FINGERS]]
    else:
        last = joints[:, 2] - joints[:, 1]
        length = np.maximum(np.linalg.norm(last, axis=1, keepdims=True), 1e-12)
        # Tips are in the unit of the points, so that `check` can recognise millimetres.
        tips = joints[:, 2] + last * (_tip_length(joints) / length)
    return np.concatenate((joints, tips[:, None]), axis=1)


def _tip_length(joints: np.ndarray) -> float:
    """Return the length to assume for a last bone, in the unit of the joints (5, 3, 3)."""
    typical = float(np.median(np.linalg.norm(np.diff(joints, axis=1), axis=-1)))
    return TIP_M if typical < _BONE_M[1] else 0.7 * typical


def _bones(hand: Keypoints) -> np.ndarray:
    """Return the lengths of the bones (5, 4) from the wrist along each finger."""
    chain = np.concatenate((np.broadcast_to(hand.wrist, (5, 1, 3)), hand.fingers), axis=1)
    return np.linalg.norm(np.diff(chain, axis=1), axis=-1)
