"""Drawing in another process: a graphics driver that fails, crashes or hangs ends no training."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from command_line import TINY, process
from pgdm.errors import RenderError
from pgdm.sim import gl
from pgdm.sim.draw import SIZE, Shots, draw
from pgdm.sim.render import Renderer

XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="object"><joint type="slide" axis="0 0 1"/><geom size=".1" rgba="1 0 0 1"/></body>
  </worldbody>
</mujoco>
"""
NO_SCREEN = {"MUJOCO_GL": "glfw", "DISPLAY": "", "WAYLAND_DISPLAY": ""}
PROGRAM = f"""
import logging, mujoco, numpy as np
logging.basicConfig(format="%(message)s")
from pgdm.sim.draw import Shots, draw
model = mujoco.MjModel.from_xml_string('''{XML}''')
shots = Shots(model, 1, np.zeros((1, 3)), np.zeros((2, 1)), ["", ""])
for _ in range(2):  # what does not work is tried once
    print(len(list(draw(shots))))
"""


@pytest.fixture
def shots() -> Shots:
    model, rise = mujoco.MjModel.from_xml_string(XML), np.linspace(0.0, 0.2, 3)
    goals = np.outer(1 + rise, [0.3, 0, 1]), np.tile([1.0, 0, 0, 0], (3, 1))
    marks = [np.zeros((0, 3)), np.full((1, 3), 0.2), np.array([[0.0, 0, 0.3], [0, 0.2, 0.3]])]
    return Shots(model, 1, np.zeros((1, 3)), rise[:, None], ["a", "", "c"], goals, marks, 0.8)


CRASH = """
import os, sys
if os.environ.get("MUJOCO_GL") == "egl" and "-m" in sys.orig_argv: os.abort()
"""


def test_pictures_are_those_of_the_renderer(shots: Shots) -> None:
    pictures = list(draw(shots))
    assert shots.goals is not None and shots.marks is not None
    with Renderer(shots.model, 1, *SIZE, shots.motion, shots.follow_m) as renderer:
        for t, picture in enumerate(pictures):
            goal = shots.goals[0][t], shots.goals[1][t]
            same = renderer.render_qpos(shots.qpos[t], goal, shots.captions[t], shots.marks[t])
            assert (picture == same).all()
    assert len(pictures) == 3 and (pictures[0] != pictures[2]).any()


def test_a_hang_is_an_error(shots: Shots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sitecustomize.py").write_text("import time; time.sleep(60)")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    monkeypatch.setattr("pgdm.sim.draw._SILENT_S", 1.0)
    monkeypatch.setattr("pgdm.sim.draw._broken", {})
    with pytest.raises(RenderError, match=r"egl: it hangs.*osmesa: it hangs.*libegl1"):
        list(draw(shots))


def test_a_crash_leads_to_the_next_backend(tmp_path: Path) -> None:
    if gl._missing("osmesa"):
        pytest.skip("needs two backends")
    (tmp_path / "sitecustomize.py").write_text(CRASH)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "egl"}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["2", "2"], done.stderr
    assert done.stderr.count("MUJOCO_GL=egl does not work here") == 1
    assert "its driver crashed (signal 6)" in done.stderr


def test_a_crash_between_pictures_loses_none(shots: Shots, monkeypatch: pytest.MonkeyPatch) -> None:
    if gl._missing("osmesa") or gl._missing("egl"):
        pytest.skip("needs two backends")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    whole, pictures = list(draw(shots)), []
    started, popen = [], subprocess.Popen

    def start(*args: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(popen(*args, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    for picture in draw(shots):
        pictures.append(picture)
        if len(pictures) == 1:
            started[0].kill()
            started[0].wait()
    assert len(pictures) == len(whole) == 3
    difference = np.abs(pictures[2].astype(int) - whole[2])
    assert difference.mean() < 1.0  # perhaps drawn by another backend


def test_no_child_outlives_its_film(shots: Shots, monkeypatch: pytest.MonkeyPatch) -> None:
    started, popen = [], subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1]
    )
    film = draw(shots)
    next(film)
    film.close()
    assert started[0].returncode is not None


@pytest.fixture
def no_osmesa(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a machine that asks for OSMesa and has a broken one."""
    for name in ("libOSMesa.so", "libOSMesa.so.6", "libOSMesa.so.8"):
        (tmp_path / name).touch()
    return {"MUJOCO_GL": "osmesa", "LD_LIBRARY_PATH": str(tmp_path), "PYOPENGL_PLATFORM": ""}


@pytest.mark.parametrize("arguments", [("--version",), ("tasks",), ("author", "list")])
@pytest.mark.parametrize("wanted", ["osmesa", "vulkan"])
def test_commands_that_draw_nothing_need_no_opengl(
    wanted: str, arguments: tuple[str, ...], no_osmesa: dict[str, str]
) -> None:
    outcome = process("pgdm", *arguments, env={**no_osmesa, "MUJOCO_GL": wanted})
    assert (outcome.code, outcome.err.count("MUJOCO_GL")) == (0, 0), outcome.err


@pytest.mark.parametrize("wanted", ["osmesa", "glfw"])
def test_a_film_is_never_worth_a_run(
    wanted: str, no_osmesa: dict[str, str], library_home: Path, tmp_path: Path
) -> None:
    films = ("eval.video=true", "eval.video_every_eval=true", "eval.interval_frames=16")
    env = {**no_osmesa, **NO_SCREEN, "MUJOCO_GL": wanted}
    run = process("pgdm-run", "--offline", *TINY, *films, "run_dir=run", env=env)
    assert (run.code, run.errors) == (0, []), run.err
    assert run.err.count("MUJOCO_GL") == 1 and wanted in run.err
    works = "drawn" if not gl._missing("egl") else "skipped"
    assert (
        len(list((tmp_path / "run" / "videos").glob("*.mp4"))) == {"drawn": 3, "skipped": 0}[works]
    )
