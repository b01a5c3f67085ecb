"""Keyframes become a smooth motion: values computed by hand, and properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pgdm.errors import ConfigError
from pgdm.library.files import keyframes as animate
from pgdm.library.files.keyframes import Keyframe, continuous, parse, sample

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


def key(
    time_s: float, pos: list[float], quat: np.ndarray = UNTURNED, stop: bool = False
) -> Keyframe:
    return Keyframe(time_s, np.array(pos, float), quat, stop)


def about_z(degrees: float) -> np.ndarray:
    half = np.deg2rad(degrees) / 2
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def test_two_keyframes_are_the_minimum_jerk_line() -> None:
    keys = [key(0, [0, 0, 0]), key(2, [0, 0, 0.2])]
    pos, _ = sample(keys, np.array([0.0, 0.5, 1.0, 2.0]))
    # 10 s^3 - 15 s^4 + 6 s^5 at s = 1/4: (160 - 60 + 6) / 1024.
    assert pos[:, 2] == pytest.approx([0, 0.2 * 106 / 1024, 0.1, 0.2], abs=1e-12)
    assert pos[:, :2] == pytest.approx(0)


def test_half_of_a_slerp_is_half_the_angle() -> None:
    keys = [key(0, [0, 0, 0]), key(1, [0, 0, 0], about_z(90))]
    _, quat = sample(keys, np.array([0.0, 0.25, 0.5, 1.0]))
    want = np.stack([about_z(90 * share) for share in (0, 106 / 1024, 0.5, 1)])
    assert quat == pytest.approx(want, abs=1e-12)


def test_the_spline_passes_through_every_keyframe() -> None:
    keys = [
        key(0, [0, 0, 0]), key(0.7, [0.1, 0, 0.2], about_z(50)),
        key(1.1, [0.2, -0.1, 0.1], about_z(120)), key(2, [0, 0, 0], about_z(180)),
    ]  # fmt: skip
    pos, quat = sample(keys, np.array([k.time_s for k in keys]))
    assert pos == pytest.approx(np.array([k.pos for k in keys]), abs=1e-12)
    assert np.abs((quat * [k.quat for k in keys]).sum(1)) == pytest.approx(1, abs=1e-12)


def test_four_quarters_are_one_full_turn() -> None:
    keys = [key(i, [0, 0, 0], about_z(90 * i)) for i in range(5)]
    times = np.linspace(0, 4, 401)
    _, quat = sample(keys, times)
    angle = np.unwrap(2 * np.arctan2(quat[:, 3], quat[:, 0]))
    assert angle[-1] == pytest.approx(2 * np.pi)
    assert (np.diff(angle) > -1e-9).all()


def test_a_stop_and_equal_keyframes_are_rests() -> None:
    keys = [key(0, [0, 0, 0]), key(1, [0, 0, 0.1]), key(2, [0, 0, 0.1]), key(3, [0.1, 0, 0.1])]
    times = np.arange(0, 3.0001, 0.01)
    pos, _ = sample(keys, times)
    held = (times >= 1) & (times <= 2)
    assert pos[held] == pytest.approx(np.tile([0, 0, 0.1], (held.sum(), 1)), abs=1e-12)
    stopped, _ = sample(
        [key(0, [0, 0, 0]), key(1, [0, 0, 0.1], stop=True), key(2, [0.1, 0, 0.1])],
        np.array([0.999, 1.0, 1.001]),
    )
    assert np.linalg.norm(np.diff(stopped, axis=0), axis=1).max() < 1e-8


coordinate = st.integers(-300, 300).map(lambda mm: mm / 1000)
poses = st.tuples(
    st.integers(5, 25).map(lambda k: 0.04 * k),
    coordinate,
    coordinate,
    coordinate,
    st.integers(-150, 150),
    st.booleans(),
)


@settings(max_examples=40)
@given(st.lists(poses, min_size=2, max_size=6))
def test_it_is_at_rest_at_its_ends_smooth_and_of_unit_length(raw: list[tuple]) -> None:
    times = np.cumsum([r[0] for r in raw]) - raw[0][0]
    keys = [
        key(float(t), list(r[1:4]), about_z(r[4]), r[5]) for t, r in zip(times, raw, strict=True)
    ]
    h = 1e-3
    wanted = np.arange(0, times[-1] + h / 2, h).clip(0, times[-1])
    pos, quat = sample(keys, wanted)
    assert np.linalg.norm(quat, axis=1) == pytest.approx(1)
    assert np.isfinite(pos).all()
    size = max(1e-3, float(np.abs([k.pos for k in keys]).max()))
    for values in (pos[:, 0], pos[:, 1], pos[:, 2]):
        # Third-order growth from rest: less than (h/T)^3 of the size by a wide margin.
        assert abs(values[1] - values[0]) < 1e-4 * size
        assert abs(values[-1] - values[-2]) < 1e-4 * size
        # C2: the acceleration never jumps, wherever the keyframes lie.
        jerk = np.abs(np.diff(values, 3)) / h**3
        assert (jerk < 4e4 * size).all()


def test_neighbours_never_point_apart() -> None:
    assert continuous(np.array([UNTURNED, -UNTURNED, -UNTURNED, UNTURNED])) == pytest.approx(
        np.tile(UNTURNED, (4, 1))
    )


def test_a_file_gives_a_trajectory_at_25_hz_relative_to_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "lift.yaml"
    path.write_text(
        "place: {pos_m: [0.02, 0.0], euler_deg: [90, 0, 0]}\n"
        "keyframes:\n  - {time_s: 0}\n  - {time_s: 1, pos_m: [0, 0, 0.1], euler_deg: [0, 0, 90]}\n"
    )
    animation = animate.read(path)
    assert animation.place == pytest.approx([0.02, 0])
    pos, quat = animation.at(np.array([0.02, 0.0, 0.05]), about_z(90))
    assert pos.shape == (26, 3) and quat.shape == (26, 4)
    assert pos[[0, -1]] == pytest.approx(np.array([[0.02, 0, 0.05], [0.02, 0, 0.15]]))
    assert abs(quat[-1] @ about_z(180)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1", "holds no keys; valid: frame, place, keyframes"),
        ("{", "not valid YAML"),
        ("keyframes: [{time_s: 0}]", "list of two or more"),
        ("frames: []", "unknown key in x 'frames'; did you mean frame"),
        ("frame: table\nkeyframes: []", "unknown frame in x 'table'"),
        ("keyframes: [{time_s: 0.1}, {time_s: 1}]", "the first must be at 0"),
        ("keyframes: [{time_s: 0}, {time_s: 0.01}]", "must come 0.04 s or more after"),
        ("keyframes: [{time_s: 0}, {time_s: 1, pos_m: [1, 2]}]", r"keyframe 1: pos_m is \[1, 2\]"),
        ("keyframes: [{time_s: 0}, {time_s: 1, pos_m: [.nan, 0, 0]}]", "NaN or infinite"),
        ("keyframes: [{time_s: 0}, {time_s: 1, quat: [1, 1, 0, 0]}]", "has norm 1.414"),
        ("keyframes: [{time_s: 0}, {time_s: 1, quad: 1}]", "unknown key in x: keyframe 1 'quad'"),
        ("keyframes: [{time_s: 0}, {time_s: now}]", "time_s is 'now'"),
        ("keyframes: [{time_s: 0}, {time_s: true}]", "time_s is True"),
        ("keyframes: [{time_s: 0}, {time_s: .nan}]", "time_s is nan"),
        ("keyframes: [{time_s: 0}, {time_s: .inf}]", "is at inf s; 3600 s at most"),
        ("keyframes: [{time_s: 0}, {time_s: 1.0e+14}]", r"is at 1e\+14 s; 3600 s at most"),
        ("keyframes: [{time_s: 0}, {time_s: 1, stop: 2}]", "stop is 2; valid: true, false"),
        ("frame: world\nplace: {pos_m: [0, 0]}\nkeyframes: []", "'place' needs frame 'rest'"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_file_is_named(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(text, "x")
