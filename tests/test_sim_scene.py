"""Centre of mass of massless bodies, and masses of objects."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from command_line import TINY, command
from pgdm.config.compose import compose
from pgdm.envs.build import EnvBuilder
from pgdm.errors import RunError
from pgdm.experiment import check_assets, env_builder
from pgdm.library import open_library
from pgdm.library.authored.drop import drop
from pgdm.library.checks.compiled import compile_tracked, compiled
from pgdm.library.published_masses import RATIOS
from pgdm.sim import scene as scenes
from pgdm.sim.assembly import scale_mass
from pgdm.sim.scene import Scene

STUDY = Path(__file__).resolve().parents[1] / "benchmark" / "results" / "study" / "runs"

MARKED = """<mujoco><worldbody><body name="object" pos="1 0 0"><joint axis="0 0 1"/>
<geom size=".1"/><body name="mark" pos=".1 .2 .3" quat=".6 .8 0 0">{}
<geom name="bump" pos=".1 .2 .3" size=".02" mass="0"/></body>
<body name="other" pos=".4 .5 .6"/></body></worldbody></mujoco>"""
INERTIAL = '<inertial pos=".3 0 0" mass="0" diaginertia="0 0 0"/>'
WEIGHED = """<mujoco><worldbody><body name="object"><joint type="slide" axis="0 0 1"/>
<geom size=".1" density="{0}"/><body pos="0 0 .1"><joint axis="1 0 0"/>
<geom size=".05" mass="{1}" pos="0 .2 0"/><body pos="0 0 .1"><joint axis="0 1 0"/>
<inertial pos=".1 0 0" mass="{1}" diaginertia="{2} {2} {2}"/>{3}</body></body></body></worldbody>
</mujoco>"""


def made(xml: str, tracked: str) -> mujoco.MjModel:
    return compile_tracked(mujoco.MjSpec.from_string(xml), tracked)


def builder(*overrides: str) -> EnvBuilder:
    return env_builder(compose(overrides), open_library())


def scene(*overrides: str) -> Scene:
    return builder(*overrides).scene


@pytest.fixture
def older() -> Iterator[pytest.MonkeyPatch]:
    """Compile scenes as earlier versions did, until undone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "compile_tracked", lambda spec, body: spec.compile())
        yield patch


def test_the_com_of_a_massless_tracked_body_is_its_origin() -> None:
    model = made(MARKED.format(""), "mark")
    assert model.body("mark").ipos == pytest.approx(np.zeros(3), abs=0)
    assert model.body("mark").iquat == pytest.approx([1, 0, 0, 0], abs=0)
    assert model.body_mass.tolist() == pytest.approx([0, 4 / 3 * np.pi * 0.1**3 * 1000, 0, 0])
    # The geom is where it was, and so is its bounding box for collision detection.
    assert model.geom("bump").pos == pytest.approx([0.1, 0.2, 0.3])
    boxes = model.bvh_aabb[model.body_bvhadr[model.body("mark").id]]
    assert boxes == pytest.approx([0.1, 0.2, 0.3, 0.02, 0.02, 0.02])
    # An untracked body stays as MuJoCo has it.
    assert model.body("other").ipos == pytest.approx([0.4, 0.5, 0.6])


def test_a_given_or_computed_com_is_kept() -> None:
    assert made(MARKED.format(INERTIAL), "mark").body("mark").ipos == pytest.approx([0.3, 0, 0])
    plain = mujoco.MjModel.from_xml_string(MARKED.format(""))
    for tracked in ("object", "nobody"):
        model = made(MARKED.format(""), tracked)
        assert np.array_equal(model.body_ipos, plain.body_ipos)


def test_objects_compiled_alone_have_the_same_com(tmp_path: Path) -> None:
    path = tmp_path / "object.xml"
    path.write_text(
        '<mujoco><worldbody><body name="arm"><joint axis="0 0 1"/><geom size=".1"/>'
        '<body name="object" pos=".1 0 0"/></body></worldbody></mujoco>'
    )
    assert compiled(path, "mark").body("object").ipos == pytest.approx(np.zeros(3), abs=0)
    # Six joints, and all of its mass in one part.
    joints = "".join(
        f'<joint type="{kind}" axis="{axis}"/>'
        for kind in ("slide", "hinge")
        for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    path.write_text(
        f'<mujoco><worldbody><body name="object" pos="0 0 .4">{joints}<geom size=".05" mass="0"/>'
        '<body name="part" pos="0 0 .01"><geom size=".02" mass="1"/></body></body></worldbody>'
        "</mujoco>"
    )
    rest = drop(path, (0.1, 0.2))
    assert rest.com == pytest.approx([0.1, 0.2, 0.05], abs=2e-3)


@pytest.mark.usefixtures("library_home")
def test_the_door_starts_at_its_first_target() -> None:
    made_builder = builder("task=door-open")
    model, body = made_builder.scene.model, made_builder.scene.index.object_body
    env = made_builder.make(1, 1)
    state = env.sim.read()
    assert np.array_equal(env.sim.data(0).xipos[body], env.sim.data(0).xpos[body])
    assert model.body_mass[body] == 0
    away = np.linalg.norm((state.object_pos[0] - env.mdp.reference.pos[0]).numpy())
    assert away == pytest.approx(0.014, abs=5e-4)
    assert made_builder.notes == []


@pytest.mark.usefixtures("library_home")
def test_a_start_far_from_the_first_target_is_reported_with_both_points(
    older: pytest.MonkeyPatch,
) -> None:
    (note,) = builder("task=door-open").notes
    assert note.startswith("the object of door-open starts 21 cm from its first target: ")
    older.undo()
    x, y, z = builder("task=door-open").make(1, 1).sim.read().object_pos[0].tolist()
    reported = [float(x) for x in re.findall(r"-?\d\.\d{3}", note)]
    # MuJoCo's point lies 15 cm from the origin along x and y, with the door nearly closed.
    assert reported[:3] == pytest.approx([x + 0.15, y - 0.15, z], abs=2e-3)
    assert reported[3:] == pytest.approx(builder("task=door-open").mdp.reference.pos[0], abs=5e-4)


@pytest.mark.usefixtures("library_home")
def test_runs_of_the_older_scene_are_distinguished(older: pytest.MonkeyPatch) -> None:
    stored = json.loads((STUDY / "pgdm-residual" / "door-open" / "result.json").read_text())
    # Only the tracked body has changed since the older scene.
    assert scene("task=door-open").digest() == stored["scene_sha256"]
    older.undo()
    now = builder("task=door-open")
    (difference,) = now.differences(stored)
    assert difference.startswith(f"scene_sha256 '{stored['scene_sha256']}', and the library now")
    assert "the tracked body door/object is massless: its centre of mass is now its" in difference
    with pytest.raises(RunError, match=r"was trained with scene_sha256 .* in another run_dir"):
        check_assets(stored, now, Path("run"), print)


@pytest.mark.usefixtures("library_home")
def test_a_run_of_the_older_scene_is_not_resumed(older: pytest.MonkeyPatch) -> None:
    arguments = ("--offline", *TINY, "task=door-open", "run_dir=run")
    assert command("pgdm-run", *arguments).code == 0
    older.undo()
    for outcome in (
        command("pgdm-run", *arguments, "total_frames=64"),
        command("pgdm", "eval", "run", "--offline"),
    ):
        assert outcome.code == 1
        (error,) = outcome.errors
        assert "scene_sha256" in error and "door/object is massless" in error
        assert "start anew in another run_dir" in error
    finished = command("pgdm-run", *arguments)
    assert finished.code == 0 and "door/object is massless" in finished.out + finished.err


@pytest.mark.parametrize("mark", ["", "<body name='mark' pos='1 0 0'/>"])
def test_scaled_masses_equal_those_of_a_model_with_such_bodies(mark: str) -> None:
    spec = mujoco.MjSpec.from_string(WEIGHED.format(1000, 1, 0.02, mark))
    scale_mass(spec, 0.5)
    model = compile_tracked(spec, "mark")
    half = made(WEIGHED.format(500, 0.5, 0.01, mark), "mark")
    # A ball of 10 cm and 500 kg/m3, and two bodies of half a kilogram.
    ball = 4 / 3 * np.pi * 0.1**3 * 500
    assert model.body_mass[1:4] == pytest.approx([ball, 0.5, 0.5])
    assert model.body_inertia[1] == pytest.approx(0.4 * ball * 0.1**2 * np.ones(3))
    assert model.body_inertia[3] == pytest.approx(0.01 * np.ones(3))
    for name in ("body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"):
        assert getattr(model, name) == pytest.approx(getattr(half, name), rel=1e-12), name
    assert model.stat.meaninertia == pytest.approx(half.stat.meaninertia, rel=1e-12)


@pytest.mark.usefixtures("library_home")
def test_published_masses_change_the_objects_only() -> None:
    volume = scene("task=spheremedium-lift")
    published = scene("task=spheremedium-lift", "sim.object_mass=published")
    ratio = np.ones(volume.model.nbody)
    ratio[volume.index.object_body] = 0.8923
    assert published.model.body_mass == pytest.approx(ratio * volume.model.body_mass)
    # 0.30422 kg in the MuJoCo of the paper's time, 0.34096 kg in 4.0.
    assert published.model.body_mass[volume.index.object_body] == pytest.approx(0.30422, rel=2e-4)
    assert published.digest() != volume.digest()


@pytest.mark.usefixtures("library_home")
def test_every_object_of_the_library_has_a_published_mass() -> None:
    library = open_library()
    objects = {name for task in library.tasks() for name in library.entry(task).objects}
    assert objects <= RATIOS.keys()
    assert builder("sim.object_mass=published").notes == []


@pytest.mark.usefixtures("library_home")
def test_an_object_without_a_published_mass_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    mass = scene().model.body("hammer/object").mass
    monkeypatch.delitem(RATIOS, "hammer")
    assert builder().notes == []
    unknown = builder("sim.object_mass=published")
    (note,) = unknown.notes
    assert "the published mass of hammer is not known; keeping the mass by volume" in note
    assert unknown.scene.model.body("hammer/object").mass == mass
