"""Smooth object motions from keyframes.

Positions are quintic splines of time, as are the rotation vectors relative to the orientation at
the preceding rest. The velocity at a keyframe is the slope of a monotone cubic interpolant, zero at
rests; the acceleration at keyframes is zero. Thus the motion is twice continuously differentiable,
starts and ends at rest, and passes through every keyframe. If the object rests at two consecutive
keyframes, it moves between them along a line and by slerp, with the minimum-jerk profile
``10 s^3 - 15 s^4 + 6 s^5``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.spatial.transform import Rotation

from pgdm import files
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library.files.columns import check_order
from pgdm.library.tasks import STEP_S

LONGEST_S = 3600.0
"""Longest motion that is sampled, s; `checks.motion` has the stricter limits of tasks."""

FRAMES = ("rest", "world")
_KEYS = ("frame", "place", "keyframes")
_PLACE_KEYS = ("pos_m", "euler_deg", "quat")
_KEYFRAME_KEYS = ("time_s", "pos_m", "euler_deg", "quat", "stop")
_MIN_GAP_S = STEP_S


@dataclass(frozen=True)
class Keyframe:
    """Pose of the object at one time."""

    time_s: float
    pos: np.ndarray = field(repr=False)
    """(3,) m, position of the centre of mass along the world's axes; in frame ``rest`` relative to
    its resting position."""
    quat: np.ndarray = field(repr=False)
    """(4,) wxyz, orientation; in frame ``rest`` the rotation from the resting orientation, about
    the world's axes."""
    stop: bool
    """Whether the object comes to rest there."""


@dataclass(frozen=True)
class Animation:
    """Keyframes, and the pose at which the object is put on the table before the motion."""

    frame: str
    """``rest``: keyframes relative to the object's resting pose; ``world``: absolute."""
    place: np.ndarray = field(repr=False)
    """(2,) m, where the object is put on the table; for frame ``rest`` only."""
    quat: np.ndarray = field(repr=False)
    """(4,) wxyz, orientation in which it is put there, world frame."""
    keyframes: tuple[Keyframe, ...]

    @property
    def length_s(self) -> float:
        """Duration, s."""
        return self.keyframes[-1].time_s

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (T, 3) m and orientations (T, 4) wxyz, one per control step.

        As in the keyframes, they are relative to the resting pose if the frame is ``rest``.
        """
        steps = int(np.ceil(self.length_s / STEP_S - 1e-9))
        times = np.minimum(STEP_S * np.arange(steps + 1), self.length_s)
        return sample(self.keyframes, times)

    def at(self, pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the trajectory in the world frame, in the shapes of :meth:`trajectory`.

        Args:
            pos: centre of mass (3,) m of the resting object.
            quat: orientation (4,) wxyz of the resting object.
        """
        moves, orientations = self.trajectory()
        if self.frame == "world":
            return moves, orientations
        rest = Rotation.from_quat(quat, scalar_first=True)
        rotated = Rotation.from_quat(orientations, scalar_first=True) * rest
        return pos + moves, continuous(rotated.as_quat(scalar_first=True))


def sample(keyframes: Sequence[Keyframe], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (T, 3) m and orientations (T, 4) wxyz at times (T,) s.

    Args:
        keyframes: two or more, in order of time; the object rests at the first and the last, at
            keyframes with ``stop``, and between consecutive keyframes with equal poses.
        times: must be within the time span of the keyframes.
    """
    key_times = np.array([k.time_s for k in keyframes])
    pos = np.array([k.pos for k in keyframes])
    quat = np.array([k.quat for k in keyframes])
    rests = _rests(keyframes)
    out_pos, out_quat = np.empty((len(times), 3)), np.empty((len(times), 4))
    for first, last in pairwise(rests):
        span = slice(first, last + 1)
        here = (times >= key_times[first]) & (times <= key_times[last])
        out_pos[here] = _spline(key_times[span], pos[span], times[here])
        base = Rotation.from_quat(quat[first], scalar_first=True)
        vectors = _vectors(base, Rotation.from_quat(quat[span], scalar_first=True))
        rotated = base * Rotation.from_rotvec(_spline(key_times[span], vectors, times[here]))
        out_quat[here] = rotated.as_quat(scalar_first=True)
    return out_pos, continuous(out_quat)


def continuous(quats: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs chosen so that consecutive dot products are >= 0."""
    flips = np.where((quats[1:] * quats[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quats * np.concatenate(([1.0], np.cumprod(flips)))[:, None]


def _rests(keyframes: Sequence[Keyframe]) -> list[int]:
    """Return the indices of the keyframes at which the object rests, including first and last."""
    same = [
        np.array_equal(a.pos, b.pos) and np.array_equal(a.quat, b.quat)
        for a, b in pairwise(keyframes)
    ]
    last = len(keyframes) - 1
    return [
        i
        for i, key in enumerate(keyframes)
        if i in (0, last) or key.stop or same[i - 1] or same[min(i, last - 1)]
    ]


def _spline(times: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return, at wanted times, the quintic curve through values (n, 3), at rest at both ends.

    In between, the slopes at the given times are those of a monotone interpolant, so that a
    coordinate does not overshoot its highest and lowest keyframes.
    """
    slopes = PchipInterpolator(times, values).derivative()(times)
    slopes[[0, -1]] = 0.0
    states = np.stack((values, slopes, np.zeros_like(values)), axis=1)  # (n, 3 orders, 3)
    return np.asarray(BPoly.from_derivatives(times, states)(wanted))


def _vectors(base: Rotation, orientations: Rotation) -> np.ndarray:
    """Return rotation vectors (n, 3) rad from the base, each as near as possible to the previous.

    Thus four quarter turns make a full turn, although the first and last orientations are equal.
    """
    vectors = (base.inv() * orientations).as_rotvec()
    for i in range(1, len(vectors)):
        angle = np.linalg.norm(vectors[i])
        before = vectors[i - 1]
        axis = vectors[i] / angle if angle > 1e-9 else _unit(before)
        around = [vectors[i] + 2 * np.pi * k * axis for k in (-2, -1, 0, 1, 2)]
        vectors[i] = min(around, key=lambda v: float(np.linalg.norm(v - before)))
    return vectors


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else np.array([1.0, 0.0, 0.0])


def read(path: Path) -> Animation:
    """Read keyframes from a YAML file; docs/authoring.md describes it.

    Raises:
        ConfigError: the file cannot be read, or an entry is wrong; the message names it.
    """
    try:
        text = files.read_text(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({files.reason(error)})") from error
    return parse(text, str(path))


def parse(text: str, label: str) -> Animation:
    """Return the animation that a YAML text describes.

    Args:
        text: the file's content.
        label: its name in messages.

    Raises:
        ConfigError: the text is not YAML, or an entry is wrong; the message names it.
    """
    try:
        content = files.parse_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{label}: {files.reason(error)}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{label}: holds no keys; valid: {', '.join(_KEYS)}")
    return animation(content, label)


def animation(content: Mapping[str, Any], label: str) -> Animation:
    """Return the animation that a parsed file describes.

    Args:
        content: the file's top-level keys.
        label: the file's name in messages.

    Raises:
        ConfigError: an entry is wrong; the message names it.
    """
    _known(content, _KEYS, label)
    frame = content.get("frame", "rest")
    if frame not in FRAMES:
        raise UnknownNameError(f"frame in {label}", str(frame), FRAMES)
    place = content.get("place") or {}
    if not isinstance(place, dict):
        raise ConfigError(f"{label}: 'place' holds no keys; valid: {', '.join(_PLACE_KEYS)}")
    _known(place, _PLACE_KEYS, f"{label}: place")
    if place and frame == "world":
        raise ConfigError(f"{label}: 'place' needs frame 'rest'; in frame 'world', remove it")
    keys = content.get("keyframes")
    if not isinstance(keys, list) or len(keys) < 2:
        raise ConfigError(f"{label}: 'keyframes' must be a list of two or more")
    keyframes = tuple(_keyframe(key, f"{label}: keyframe {i}") for i, key in enumerate(keys))
    _check_times(keyframes, label)
    at = _numbers(place, "pos_m", 2, [0.0, 0.0], f"{label}: place")
    return Animation(str(frame), at, _quat(place, f"{label}: place"), keyframes)


def _keyframe(key: Any, label: str) -> Keyframe:
    if not isinstance(key, dict):
        raise ConfigError(f"{label} holds no keys; valid: {', '.join(_KEYFRAME_KEYS)}")
    _known(key, _KEYFRAME_KEYS, label)
    time_s = key.get("time_s")
    if isinstance(time_s, bool) or not isinstance(time_s, int | float) or time_s != time_s:
        raise ConfigError(f"{label}: time_s is {time_s!r}, not a number")
    stop = key.get("stop", False)
    if not isinstance(stop, bool):
        raise ConfigError(f"{label}: stop is {stop!r}; valid: true, false")
    pos = _numbers(key, "pos_m", 3, [0.0, 0.0, 0.0], label)
    return Keyframe(float(time_s), pos, _quat(key, label), stop)


def _check_times(keyframes: Sequence[Keyframe], label: str) -> None:
    times = [key.time_s for key in keyframes]
    if times[0] != 0.0:
        raise ConfigError(f"{label}: keyframe 0 has time_s {times[0]:g}; the first must be at 0")
    for i, (one, two) in enumerate(pairwise(times)):
        if not two - one >= _MIN_GAP_S - 1e-9:
            raise ConfigError(
                f"{label}: keyframe {i + 1} at {two:g} s must come {_MIN_GAP_S:g} s or more "
                f"after keyframe {i} at {one:g} s"
            )
    if times[-1] > LONGEST_S:
        raise ConfigError(
            f"{label}: the last keyframe is at {times[-1]:g} s; {LONGEST_S:g} s at most"
        )


def _quat(key: Mapping[str, Any], label: str) -> np.ndarray:
    """Return the orientation (4,) wxyz of a keyframe or place, by default the identity."""
    if "quat" in key and "euler_deg" in key:
        raise ConfigError(f"{label}: both quat and euler_deg are given; remove one")
    if "quat" not in key:
        angles = _numbers(key, "euler_deg", 3, [0.0, 0.0, 0.0], label)
        orientation = Rotation.from_euler("XYZ", angles, degrees=True)
        return np.asarray(orientation.as_quat(scalar_first=True))
    quat = _numbers(key, "quat", 4, [], label)
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1.0) > 0.01:
        raise ConfigError(f"{label}: quat has norm {norm:.4g}, not a unit quaternion (wxyz)")
    check_order(quat / norm, Rotation.identity(), f"{label}: quat", "write w x y z, or euler_deg")
    return quat / norm


def _numbers(
    key: Mapping[str, Any], name: str, count: int, default: list[float], label: str
) -> np.ndarray:
    value = key.get(name, default)
    good = isinstance(value, list) and len(value) == count
    if not good or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        raise ConfigError(f"{label}: {name} is {value!r}, not {count} numbers")
    numbers = np.array(value, np.float64)
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{label}: {name} is {value!r}: NaN or infinite")
    return numbers


def _known(content: Mapping[str, Any], valid: Sequence[str], label: str) -> None:
    for key in content:
        if key not in valid:
            raise UnknownNameError(f"key in {label}", str(key), valid)
