"""Drawing in a child process, so that a crashing graphics driver cannot kill the caller."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO, Any

import mujoco
import numpy as np

from pgdm.errors import RenderError
from pgdm.sim import gl
from pgdm.sim.render import Renderer

SIZE = (640, 480)
"""Width and height of the pictures, pixels."""
_SILENT_S = 120.0  # time per picture after which the driver is considered hung
_MODEL = "model.mjb"

_broken: dict[str, str] = {}  # backends that drew nothing, with reasons; not tried again


@dataclass(frozen=True)
class Shots:
    """States of a scene, to be drawn as one picture each."""

    model: mujoco.MjModel
    object_body: int
    """Id of the tracked body."""
    motion: np.ndarray
    """Points that a fixed camera keeps in view, (T, 3) m, world frame."""
    qpos: np.ndarray
    """(K, nq)."""
    captions: Sequence[str]
    """Text of each picture, (K,)."""
    goals: tuple[np.ndarray, np.ndarray] | None = None
    """Targets, drawn as a translucent object: centre of mass (K, 3) m and orientation (K, 4) wxyz,
    world frame."""
    marks: Sequence[np.ndarray] | None = None
    """For each of K pictures, points (n, 3) m, world frame, to show as small spheres."""
    follow_m: float | None = None
    """Height of the world shown by a camera that follows the object, m; None: a fixed camera."""


def draw(shots: Shots) -> Iterator[np.ndarray]:
    """Yield pictures (H, W, 3) uint8, drawn in a child process with the first working backend.

    Raises:
        RenderError: if none works.
    """
    reasons, drawn = {}, 0
    for backend in gl.backends():
        before, reason = drawn, _broken.get(backend)
        if reason is None:
            try:
                for picture in _drawn_with(backend, shots, drawn):
                    drawn += 1
                    yield picture
            except RenderError as error:
                reason = str(error)
                if drawn == before:
                    _broken[backend] = reason
        if reason is None:
            gl.note_failures(reasons, backend)
            return
        reasons[backend] = reason
    raise gl.no_opengl(reasons)


def _drawn_with(backend: str, shots: Shots, first: int) -> Iterator[np.ndarray]:
    width, height = SIZE
    with tempfile.TemporaryFile() as task, tempfile.TemporaryFile() as errors:
        _write(task, shots, first)
        task.seek(0)
        child = subprocess.Popen(
            [sys.executable, "-m", "pgdm.sim.draw"],
            stdin=task,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=gl.environment(backend),
            start_new_session=True,  # so that Ctrl-C reaches the caller only
        )
        try:
            for _ in shots.qpos[first:]:
                picture = np.frombuffer(_read(child, width * height * 3, errors), np.uint8)
                yield picture.reshape(height, width, 3)
        finally:
            child.kill()
            child.wait()
            assert child.stdout is not None
            child.stdout.close()


def _read(child: subprocess.Popen[bytes], size: int, errors: IO[bytes]) -> bytes:
    assert child.stdout is not None
    pipe, found = child.stdout.fileno(), bytearray()
    while len(found) < size:
        if not select.select([pipe], [], [], _SILENT_S)[0]:
            raise RenderError(f"it hangs: no picture in {_SILENT_S:.0f} s")
        part = os.read(pipe, size - len(found))
        if not part:
            errors.seek(0)
            code = child.wait()
            raise RenderError(gl.why_ended(code, errors.read().decode(errors="replace")))
        found += part
    return bytes(found)


def _write(task: IO[bytes], shots: Shots, first: int) -> None:
    """Write what the child process needs as an ``.npz``, from picture ``first`` on."""
    model = np.empty(mujoco.mj_sizeModel(shots.model), np.uint8)
    mujoco.mj_saveModel(shots.model, None, model)
    arrays: dict[str, Any] = {
        "model": model,
        "motion": shots.motion,
        "object_body": shots.object_body,
        "follow_m": np.nan if shots.follow_m is None else shots.follow_m,
        "qpos": shots.qpos[first:],
        "captions": np.array(shots.captions[first:], str),
    }
    if shots.goals is not None:
        arrays |= {"goal_pos": shots.goals[0][first:], "goal_quat": shots.goals[1][first:]}
    if shots.marks is not None:
        marks = shots.marks[first:]
        arrays |= {"marks": np.concatenate(marks), "counts": np.array([len(m) for m in marks])}
    np.savez(task, **arrays)


def main() -> None:
    """Read shots from stdin and draw them; write the pictures' raw bytes to stdout."""
    from mujoco.gl_context import GLContext  # of the backend that MUJOCO_GL names

    pipe = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # drivers print there
    with np.load(sys.stdin.buffer) as file:
        shots = dict(file)
    model = mujoco.MjModel.from_binary_path(_MODEL, {_MODEL: shots["model"].tobytes()})
    follow = None if np.isnan(shots["follow_m"]) else float(shots["follow_m"])
    ends = np.cumsum(shots["counts"])[:-1] if "counts" in shots else None
    marks = None if ends is None else np.split(shots["marks"], ends)
    body, motion = int(shots["object_body"]), shots["motion"]
    camera = Renderer(model, body, *SIZE, motion, follow, GLContext)
    with camera, os.fdopen(pipe, "wb") as out:
        for t, (qpos, caption) in enumerate(zip(shots["qpos"], shots["captions"], strict=True)):
            goal = (shots["goal_pos"][t], shots["goal_quat"][t]) if "goal_pos" in shots else None
            mark = None if marks is None else marks[t]
            out.write(camera.render_qpos(qpos, goal, str(caption), mark).tobytes())
            out.flush()


if __name__ == "__main__":
    main()
