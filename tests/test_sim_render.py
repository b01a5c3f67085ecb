"""Rendering: ghost, camera, choice of OpenGL, images and videos."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image

from pgdm.errors import RenderError
from pgdm.sim import gl
from pgdm.sim.camera import AZIMUTHS_DEG
from pgdm.sim.render import Renderer, write_image, write_video

# A red object like a hammer (centre of mass away from its origin, with a marker body), an actuated
# grey finger and a dark table.
XML = """
<mujoco>
  <visual><global fovy="25" offwidth="64" offheight="48"/></visual>
  <worldbody>
    <light pos="0 0 10" dir="0 0 -1" diffuse=".8 .8 .8"/>
    <geom type="box" size=".45 .45 .02" pos="0 0 -.02" rgba=".1 .1 .1 1"/>
    <body name="finger" pos="0 -.3 .1">
      <joint name="slide" type="slide" axis="0 1 0"/>
      <geom type="capsule" size=".02 .05" rgba=".5 .5 .5 1"/>
    </body>
    <body name="object" pos="0 0 .1" quat=".9 .1 .3 .2">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <geom type="box" size=".08 .01 .02" rgba="1 0 0 1"/>
      <geom type="capsule" size=".015 .05" pos=".08 0 0" rgba="1 0 0 1"/>
      <geom type="sphere" size=".5" rgba="1 1 1 0" mass="0" contype="0" conaffinity="0"/>
      <body name="marker" pos=".04 0 0"><geom type="sphere" size=".01" rgba="0 0 0 0"/></body>
    </body>
    {extra}
  </worldbody>
  <actuator><position joint="slide"/></actuator>
</mujoco>
"""
BOARD = '<geom type="box" size=".3 .01 .5" pos="0 .25 .5" rgba=".3 .3 .9 1"/>'


@pytest.fixture(scope="module", autouse=True)
def _needs_opengl() -> None:
    try:
        gl.context_class()
    except RenderError as error:
        pytest.skip(str(error))


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(extra=""))


def red(picture: np.ndarray) -> np.ndarray:
    r, g, b = (picture[..., i].astype(int) for i in range(3))
    return (r > 60) & (r > 2 * g) & (r > 2 * b)


def green(picture: np.ndarray) -> np.ndarray:
    r, g, b = (picture[..., i].astype(int) for i in range(3))
    return (g > 40) & (g > 1.4 * r) & (g > 1.4 * b)


def pose(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.body(name).xipos.copy(), data.body(name).xquat.copy()


def test_the_image_shows_the_object(model: mujoco.MjModel) -> None:
    with Renderer(model, model.body("object").id, 160, 120) as renderer:
        picture = renderer.render_qpos(np.zeros(model.nq))
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert 50 < red(picture).sum() < 2000
    assert not green(picture).any()


@pytest.mark.parametrize("tracked", ["object", "marker"])
def test_the_ghost_covers_an_object_at_its_goal(model: mujoco.MjModel, tracked: str) -> None:
    with Renderer(model, model.body(tracked).id, 320, 240) as renderer:
        plain = renderer.render_qpos(np.zeros(model.nq))
        ghosted = renderer.render_qpos(np.zeros(model.nq), pose(model, tracked))
        away, quat = pose(model, tracked)
        moved = renderer.render_qpos(np.zeros(model.nq), (away + np.array([0, 0, 0.12]), quat))
    drawn = np.abs(ghosted.astype(int) - plain).sum(axis=-1) > 20
    outside = drawn & ~red(plain)
    assert outside.sum() < 0.1 * red(plain).sum()  # rims only
    shift = np.argwhere(red(plain)).mean(axis=0) - np.argwhere(green(moved)).mean(axis=0)
    assert abs(shift[1]) < 3  # straight up in the image ...
    assert 25 < shift[0] < 60  # ... by 0.12 m of the 0.6 m or more that 240 rows show
    assert 0.7 < green(moved).sum() / red(plain).sum() < 1.3  # and of the size of the object


def test_the_ghost_rotates_with_the_goal(model: mujoco.MjModel) -> None:
    com, quat = pose(model, "object")
    turned = np.array([quat[3], -quat[2], quat[1], quat[0]])
    with Renderer(model, model.body("object").id, 160, 120) as renderer:
        one = renderer.render_qpos(np.zeros(model.nq), (com + np.array([0, 0, 0.15]), quat))
        two = renderer.render_qpos(np.zeros(model.nq), (com + np.array([0, 0, 0.15]), turned))
    assert (green(one) ^ green(two)).sum() > 20


def test_the_callers_state_and_model_are_not_changed(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.qpos[1] = 0.1
    mujoco.mj_forward(model, data)
    before = data.xpos.copy(), model.vis.quality.offsamples, model.vis.global_.offwidth
    with Renderer(model, model.body("object").id, 160, 120) as renderer:
        there = renderer.render(data, caption="step 3")
        assert (renderer.render_qpos(data.qpos, caption="step 3") == there).all()
        assert (renderer.render(data) != there).any()  # without the text
    assert (data.xpos == before[0]).all()
    assert (model.vis.quality.offsamples, model.vis.global_.offwidth) == before[1:]


def test_rendering_after_close_is_an_error(model: mujoco.MjModel) -> None:
    renderer = Renderer(model, 1, 64, 48)
    renderer.close()
    renderer.close()
    with pytest.raises(RenderError, match="closed"):
        renderer.render_qpos(np.zeros(model.nq))


def test_two_renderers_in_one_process(model: mujoco.MjModel) -> None:
    with Renderer(model, 1, 64, 48) as one, Renderer(model, 1, 96, 64) as two:
        first = one.render_qpos(np.zeros(model.nq))
        assert two.render_qpos(np.zeros(model.nq)).shape == (64, 96, 3)
        assert (one.render_qpos(np.zeros(model.nq)) == first).all()


def test_the_whole_motion_is_in_view(model: mujoco.MjModel) -> None:
    com, quat = pose(model, "object")
    motion = com + np.linspace(0, 1, 20)[:, None] * [0.8, -0.3, 0.5]
    with Renderer(model, model.body("object").id, 160, 120, motion=motion) as renderer:
        plain = renderer.render_qpos(np.zeros(model.nq))
        shown = [renderer.render_qpos(np.zeros(model.nq), (p, quat)) for p in motion[[0, -1]]]
    for picture in shown:
        rows, columns = np.nonzero((picture != plain).any(axis=-1))
        assert rows.min() > 0 and rows.max() < 119
        assert columns.min() > 0 and columns.max() < 159


def test_the_camera_avoids_a_board_that_hides_the_motion(model: mujoco.MjModel) -> None:
    hidden = mujoco.MjModel.from_xml_string(XML.format(extra=BOARD))
    motion = pose(hidden, "object")[0][None]
    with Renderer(hidden, hidden.body("object").id, 160, 120, motion=motion) as renderer:
        assert renderer._camera.azimuth != AZIMUTHS_DEG[0]
        assert red(renderer.render_qpos(np.zeros(hidden.nq))).sum() > 50
    with Renderer(model, model.body("object").id, 160, 120, motion=motion) as renderer:
        assert renderer._camera.azimuth == AZIMUTHS_DEG[0]


def test_the_error_without_opengl_names_packages_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl, "_LIBRARIES", {"egl": "libEGL-none.so", "osmesa": "libOSMesa-none.so"})
    with pytest.raises(RenderError, match=r"libEGL-none.so.*libegl1.*libosmesa6"):
        gl.context_class.__wrapped__()


@pytest.mark.parametrize("value", ["off", "disabled", "0"])
def test_rendering_switched_off_by_the_user(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", value)
    with pytest.raises(RenderError, match=f"MUJOCO_GL={value}"):
        gl.context_class.__wrapped__()


def chosen(**env: str) -> subprocess.CompletedProcess[str]:
    """Return a process, with these variables, that renders and prints its OpenGL backend."""
    program = (
        "import mujoco, numpy as np\n"
        "from pgdm.sim.render import Renderer\n"
        "from pgdm.sim.gl import context_class\n"
        'm = mujoco.MjModel.from_xml_string(\'<mujoco><worldbody><body><geom size=".1"/></body>'
        "</worldbody></mujoco>')\n"
        "r = Renderer(m, 1, 64, 48)\n"
        "assert r.render_qpos(np.zeros(0)).any()\n"
        "print(context_class().__module__)\n"
    )
    base = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    return subprocess.run(
        [sys.executable, "-c", program], env=base | env, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("env", "backend"),
    [
        ({}, "egl"),
        ({"MUJOCO_GL": "osmesa"}, "osmesa"),
        ({"MUJOCO_GL": "egl"}, "egl"),
        ({"PYOPENGL_PLATFORM": "osmesa"}, "osmesa"),  # a program's choice that excludes the others
    ],
)
def test_choice_of_opengl(
    env: dict[str, str], backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)  # this process has set it
    if gl._why_not(backend) is not None:
        pytest.skip(f"{backend} does not work here")
    done = chosen(**env)
    assert done.stdout.strip() == f"mujoco.{backend}", done.stderr
    assert done.stderr == ""  # no complaints at the exit of the interpreter


def test_the_gpu_compiler_is_loaded_before_opengl(tmp_path: Path) -> None:
    (tmp_path / "triton.py").write_text(
        "import sys\n"
        "assert not {'mujoco.egl', 'mujoco.osmesa', 'OpenGL'} & set(sys.modules)\n"
        "print('triton first')\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = chosen(PYTHONPATH=path)
    assert done.stdout.startswith("triton first"), done.stderr


def test_an_unusable_choice_gives_way_to_the_others() -> None:
    done = chosen(MUJOCO_GL="glfw", DISPLAY=":77", WAYLAND_DISPLAY="none")
    assert done.stdout.strip() in ("mujoco.egl", "mujoco.osmesa")
    assert "MUJOCO_GL=glfw does not work here" in done.stderr


def film(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    return [np.full((height, width, 3), 20 * i, np.uint8) for i in range(count)]


def test_videos_have_a_format_that_plays_everywhere(tmp_path: Path) -> None:
    poster = write_video(tmp_path / "videos" / "a.mp4", film(7, 49, 65), fps=25)
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    command = [
        ffmpeg,
        "-i",
        str(tmp_path / "videos" / "a.mp4"),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "gray",
    ]
    done = subprocess.run([*command, "-"], capture_output=True, check=True)
    assert len(done.stdout) == 7 * 48 * 64
    stream = next(line for line in done.stderr.decode().splitlines() if "Video:" in line)
    assert "h264" in stream and "yuv420p" in stream and "64x48" in stream and "25 fps" in stream
    assert poster == tmp_path / "videos" / "a.png"
    with Image.open(poster) as picture:
        assert picture.size == (64, 48)
        assert picture.getpixel((5, 5)) == (60, 60, 60)  # frame 3, in the middle
    assert sorted(p.name for p in poster.parent.iterdir()) == ["a.mp4", "a.png"]


def test_a_video_is_replaced_atomically(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, film(3))
    before = path.read_bytes()

    def breaks() -> Iterator[np.ndarray]:
        yield film(1)[0]
        raise ValueError("simulation ended")

    with pytest.raises(ValueError, match="simulation ended"):
        write_video(path, breaks())
    with pytest.raises(RenderError, match="no frames"):
        write_video(path, [])
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "a.png"]


def test_unwritable_paths_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RenderError, match="cannot write"):
        write_video(tmp_path / "file" / "a.mp4", film(2))
    with pytest.raises(RenderError, match="cannot write"):
        write_image(tmp_path / "file" / "a.png", film(1)[0])
