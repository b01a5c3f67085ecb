"""Pre-grasps predicted from shapes: codes, grasp vectors, fit, file, and candidates."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from command_line import TINY, command
from pgdm.errors import ConfigError, CorruptAssetError, SceneError
from pgdm.library.clearance import CLEARANCE_M
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.candidates import free_ones, freed, propose
from pgdm.pregrasp.predict.encoding import (
    BASIS_POINTS,
    BASIS_RADIUS_M,
    basis,
    encode,
    object_code,
    surface_points,
)
from pgdm.pregrasp.predict.grasp_vector import POSITION, GraspFrame, rotation_of
from pgdm.pregrasp.predict.predictor import Example, Predictor, anchored, example, fit, off
from pgdm.sim.contact import HandContact
from task_scenes import opened


def mined(name: str) -> np.ndarray:
    return np.array(opened(name)[1].starts["mined"].qpos)


def surface(geoms: str) -> np.ndarray:
    """Return the surface points of a body made of MJCF geoms."""
    xml = f"<mujoco><worldbody><body name='thing'>{geoms}</body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return surface_points(model, data, model.body("thing").id)


def test_the_code_of_a_sphere_is_exact() -> None:
    code = encode(surface("<geom type='sphere' size='0.05'/>"))
    exact = np.abs(np.linalg.norm(basis(), axis=1) - 0.05)
    assert code.shape == (BASIS_POINTS,)
    assert np.linalg.norm(basis(), axis=1).max() <= BASIS_RADIUS_M
    np.testing.assert_allclose(code * BASIS_RADIUS_M, exact, atol=0.002)


def test_a_turned_box_is_encoded_in_its_orientation() -> None:
    code = encode(surface("<geom type='box' size='0.04 0.02 0.03' euler='0 0 90'/>"))
    half = np.array([0.02, 0.04, 0.03])  # a quarter turn about z swaps x and y
    beyond = np.abs(basis()) - half
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    exact = np.where((beyond < 0).all(axis=1), -beyond.max(axis=1), outside)
    np.testing.assert_allclose(code * BASIS_RADIUS_M, exact, atol=0.004)


def test_surfaces_inside_other_parts_are_left_out() -> None:
    points = surface("<geom type='box' size='.05 .05 .05'/><geom type='sphere' size='.02'/>")
    assert np.abs(points).max(axis=1).min() > 0.0499  # nothing of the sphere is left


def test_an_object_without_collision_geoms_is_refused() -> None:
    with pytest.raises(SceneError, match="body 'thing' has no collision geom to encode"):
        surface("<geom size='.1' contype='0' conaffinity='0'/>")


def test_any_six_numbers_give_a_rotation() -> None:
    stream = np.random.default_rng(0)
    for columns in stream.standard_normal((100, 6)):
        turn = rotation_of(columns)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert turn[:, 0] @ columns[:3] == pytest.approx(np.linalg.norm(columns[:3]))
    np.testing.assert_allclose(rotation_of(np.array([2.0, 0, 0, 1.0, 3.0, 0])), np.eye(3))


@pytest.mark.parametrize("name", ["hammer-use1", "dhand-cup", "dmanus-crackerbox"])
def test_a_hand_comes_back_from_its_vector(library_home: Path, name: str) -> None:
    scene, _ = opened(name)
    nu, objects = scene.model.nu, mined(name)
    low, high = scene.model.jnt_range[:nu].T
    frame = GraspFrame(scene, np.array([0.01, -0.05, 0.1]))
    stream = np.random.default_rng(1)
    for _ in range(20):
        qpos = objects.copy()
        qpos[:nu] = low + stream.uniform(0.05, 0.95, nu) * (high - low)
        qpos[4] = stream.uniform(-1.5, 1.5)  # beyond a right angle there are two solutions
        vector = frame.vector(qpos)
        np.testing.assert_allclose(frame.qpos(vector, objects)[6:], qpos[6:], atol=1e-9)
        back = frame.qpos(vector, objects)
        np.testing.assert_allclose(frame.vector(back), vector, atol=1e-9)
        np.testing.assert_allclose(back, qpos, atol=1e-6)
        np.testing.assert_allclose(frame.fingertips_of(vector), frame.fingertips(qpos), atol=1e-9)


def test_out_of_reach_the_base_stays_within_its_limits(library_home: Path) -> None:
    scene, _ = opened("hammer-use1")
    frame, objects = GraspFrame(scene), mined("hammer-use1")
    vector = frame.vector(objects)
    vector[POSITION] += (0.05, 0.6, 0.0)  # beyond the slide across the table
    qpos = frame.qpos(vector, objects)
    low, high = scene.model.jnt_range[: scene.model.nu].T
    assert (qpos[:30] >= low - 1e-9).all() and (qpos[:30] <= high + 1e-9).all()
    clipped = objects.copy()
    clipped[:6] += (0.05, 0.6, 0.0, 0, 0, 0)
    clipped[:30] = clipped[:30].clip(low, high)
    wanted = frame.fingertips_of(vector)
    away = [np.linalg.norm(frame.fingertips(q) - wanted) for q in (qpos, clipped)]
    assert away[0] <= away[1] + 1e-6


def made_up(count: int = 12) -> tuple[list[Example], GraspFrame]:
    """Return invented examples: the larger the sphere, the higher the hand."""
    scene, _ = opened("hammer-use1")
    frame, found = GraspFrame(scene), []
    start = frame.vector(mined("hammer-use1"))
    for i, radius in enumerate(np.linspace(0.02, 0.08, count)):
        vector = start.copy()
        vector[2] += radius
        code = np.abs(np.linalg.norm(basis(), axis=1) - radius) / BASIS_RADIUS_M
        found.append(Example(f"t{i}", f"ball{i}", code, vector, frame.fingertips_of(vector)))
    return found, frame


def test_the_fit_finds_what_depends_on_the_shape(library_home: Path) -> None:
    examples, frame = made_up()
    told: list[tuple[int, int]] = []
    predictor = fit(examples, frame, progress=lambda _, i, n: told.append((i, n)))
    assert predictor.error_m < 0.2 * predictor.mean_hand_error_m
    # Leaving one of 12 out puts it at 12/11 of its distance from the mean.
    radii = np.linspace(0.02, 0.08, 12)
    expected = np.abs(radii - radii.mean()).mean() * 12 / 11
    assert predictor.mean_hand_error_m == pytest.approx(expected, rel=1e-6)
    assert told[-1][0] == told[-1][1]
    mean = fit(examples, frame, penalties=(np.inf,))
    assert mean.error_m == mean.mean_hand_error_m == predictor.mean_hand_error_m
    vectors = [anchored(e.vector, mean.anchor_m) for e in examples]
    np.testing.assert_allclose(mean.expected(examples[0].code), np.mean(vectors, axis=0))


def test_one_object_grasped_in_several_ways_shows_no_effect_of_shape(library_home: Path) -> None:
    """Its codes differ only by how it was put down."""
    examples, frame = made_up(2)
    ways = [
        replace(examples[0], code=examples[0].code + 1e-5 * i, vector=examples[i % 2].vector)
        for i in range(4)
    ]
    found = fit([*ways, examples[1]], frame)
    assert found.error_m == pytest.approx(found.mean_hand_error_m, rel=0.05)


def test_samples_depend_on_the_seed_alone_and_begin_with_the_mean(library_home: Path) -> None:
    examples, frame = made_up()
    predictor, code = fit(examples, frame), examples[3].code
    one = predictor.sample(code, 5, seed=3)
    np.testing.assert_array_equal(one, predictor.sample(code, 5, seed=3))
    np.testing.assert_array_equal(one[0], predictor.expected(code))
    assert np.abs(one - predictor.sample(code, 5, seed=4))[1:].max() > 1e-4


def test_one_object_is_too_few(library_home: Path) -> None:
    examples, frame = made_up(3)
    with pytest.raises(ConfigError, match=r"3 pre-grasps of 1 object .*at least 2"):
        fit([replace(e, object="ball") for e in examples], frame)


@pytest.fixture
def predictor(library_home: Path) -> Predictor:
    return fit(*made_up(), left_out=("cup",))


def test_weights_are_read_as_written(predictor: Predictor) -> None:
    path = weights.path_of("adroit")
    weights.write(path, predictor)
    back = weights.read(path, "adroit")
    for name, value in vars(predictor).items():
        np.testing.assert_array_equal(getattr(back, name), value)


def test_weights_that_do_not_fit_are_refused(predictor: Predictor, tmp_path: Path) -> None:
    path = tmp_path / "some.pt"
    with pytest.raises(ConfigError, match="no predictor for hand 'dhand'; train one with 'pgdm"):
        weights.read(path, "dhand")
    weights.write(path, predictor)
    with pytest.raises(ConfigError, match="is for hand 'adroit', not 'dhand'"):
        weights.read(path, "dhand")
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"no weights at all"):
        path.write_bytes(damaged)
        with pytest.raises(CorruptAssetError, match="damaged"):
            weights.read(path, "adroit")
    torch.save({"format": "pgdm-predictor-0"}, path)
    with pytest.raises(CorruptAssetError, match="format 'pgdm-predictor-0', not"):
        weights.read(path, "adroit")
    torch.save(Path("/"), path)  # an object that needs code to unpickle
    with pytest.raises(CorruptAssetError, match="damaged"):
        weights.read(path, "adroit")


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("slope", torch.zeros(3, 3), "shape"),
        ("mean", torch.full((33,), torch.nan), "not finite"),
        ("objects", None, "invalid"),
    ],
)
def test_spoiled_weights_are_refused(
    predictor: Predictor, tmp_path: Path, name: str, value: object, reason: str
) -> None:
    path = tmp_path / "some.pt"
    weights.write(path, predictor)
    content = torch.load(path, weights_only=True)
    torch.save(content | {name: value}, path)
    with pytest.raises(CorruptAssetError, match=reason):
        weights.read(path, "adroit")


def test_a_hand_inside_an_object_is_freed_reproducibly(library_home: Path) -> None:
    scene, _ = opened("duck-lift")
    qpos = mined("duck-lift")
    contact = HandContact(scene)
    assert contact.depth(qpos) > 0.005  # as published
    free = freed(scene, qpos, seed=2)
    assert free is not None and contact.overlap(free, CLEARANCE_M) == 0.0
    again = freed(scene, qpos, seed=2)
    assert again is not None
    np.testing.assert_array_equal(free, again)
    np.testing.assert_array_equal(free[scene.model.nu :], qpos[scene.model.nu :])


def test_candidates_touch_nothing(library_home: Path) -> None:
    scene, _ = opened("hammer-use1")
    one = example(scene, mined("hammer-use1"))
    assert one is not None and one.object == "hammer"
    np.testing.assert_array_equal(one.code, object_code(scene, mined("hammer-use1")))
    frame = GraspFrame(scene)
    assert off(frame, one.vector, one) < 0.005  # joints beyond their limits were clipped
    lower = one.vector.copy()
    lower[2] -= 0.03  # into the table
    found = free_ones(frame, [lower, one.vector], mined("hammer-use1"))
    assert [c.quality.free for c in found] == [True, True]
    assert found[0].moved_m < found[1].moved_m


def test_a_door_is_no_example_and_not_predicted(library_home: Path, predictor: Predictor) -> None:
    scene, _ = opened("door-open")
    assert example(scene, mined("door-open")) is None
    with pytest.raises(ConfigError, match="is attached to something"):
        propose(predictor, scene, mined("door-open"), 1)
    other, _ = opened("dhand-cup")
    with pytest.raises(ConfigError, match="for hand 'adroit', task 'dhand-cup' has 'dhand'"):
        propose(predictor, other, mined("dhand-cup"), 1)


@pytest.mark.slow
def test_from_training_to_a_stored_pregrasp(library_home: Path, tmp_path: Path) -> None:
    made = command("pgdm", "pregrasp", "train", "--hand", "dmanus", "--leave-out", "hammer")
    assert "unknown object to leave out 'hammer'" in made.errors[0]
    made = command("pgdm", "pregrasp", "train", "--hand", "dmanus")
    assert made.code == 0, made.err
    assert "5 pre-grasps of 2 objects" in made.out and "very few" in made.out
    arguments = ("pregrasp", "predict", "dmanus-crackerbox", "--samples", "2", "--no-reach")
    image = tmp_path / "candidates.png"
    done = command("pgdm", *arguments, "--image", str(image), "--offline")
    assert done.code == 0, done.err
    assert "'crackerbox' was in the training set" in done.err
    stored = pregrasp_file.find("dmanus-crackerbox", "dmanus", "learned")
    assert stored is not None and stored.note["held_out"] is False
    assert image.stat().st_size > 10_000
    scene, _ = opened("dmanus-crackerbox")
    assert HandContact(scene).depth(stored.pose.qpos) == 0.0
    again = command("pgdm", *arguments, "--offline")
    assert again.code == 0
    other = pregrasp_file.find("dmanus-crackerbox", "dmanus", "learned")
    assert other is not None
    np.testing.assert_array_equal(stored.pose.qpos, other.pose.qpos)
    # With a predictor, a run computes its start automatically.
    path = pregrasp_file.path_of("dmanus-coffeecan", "dmanus", "learned")
    run = ("task=dmanus-coffeecan", "pregrasp=learned", "--offline", *TINY)
    ended = command("pgdm-run", *run, f"run_dir={tmp_path / 'run'}")
    assert ended.code == 0, ended.err
    assert "computing it once by prediction and a reach plan" in ended.err
    assert pregrasp_file.read(path).note["held_out"] is False
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["pregrasp_used"] == "learned"
