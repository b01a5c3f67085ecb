"""Selection of an OpenGL backend that renders without a screen."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from pgdm.errors import RenderError

CURE = (
    "install one of the system packages libegl1 (EGL, also with NVIDIA's driver) or libosmesa6 "
    "(software), on Debian and Ubuntu: "
    "apt-get install libegl1 libopengl0 libgl1-mesa-dri libosmesa6"
)
_VALID = "egl, osmesa, glfw, disable"
_OFF = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1")  # MuJoCo's words for "choose one"
_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
_BACKENDS = (*_LIBRARIES, "glfw")  # glfw is the last: it needs a screen
_HIDDEN = "PGDM_MUJOCO_GL"  # the value of MUJOCO_GL while `deferred` hides it
_PROBE = """
import mujoco
from mujoco.gl_context import GLContext
context = GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50).free()
context.free()
"""
_PROBE_TIMEOUT_S = 60.0

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Hide a ``MUJOCO_GL`` that would make importing MuJoCo fail; `backends` still reads it.

    MuJoCo loads OpenGL when it is imported. A command that draws nothing does not need it, and
    a run can draw its videos with another backend.
    """
    value = os.environ.get("MUJOCO_GL", "")
    name = value.lower().strip()
    known = (*_BACKENDS, *_ANY, *_OFF, "glx", "wgl", "cgl")
    if name in known and (name not in _LIBRARIES or _missing(name) is None):
        yield
        return
    os.environ[_HIDDEN] = os.environ.pop("MUJOCO_GL")
    try:
        yield
    finally:
        os.environ["MUJOCO_GL"] = os.environ.pop(_HIDDEN)


def backends() -> list[str]:
    """Return the OpenGL backends to try, the user's choice first.

    The user chooses with ``MUJOCO_GL`` or PyOpenGL's ``PYOPENGL_PLATFORM``. On Linux the backends
    are EGL, OSMesa and GLFW; those not chosen keep this order. Elsewhere the only one is "", which
    leaves the choice to MuJoCo.

    Raises:
        RenderError: if ``MUJOCO_GL`` switches rendering off.
    """
    value = os.environ.get(_HIDDEN, os.environ.get("MUJOCO_GL", ""))
    wanted = value.lower().strip()
    if wanted in _OFF:
        raise RenderError(f"rendering is switched off by MUJOCO_GL={wanted}; unset it to render")
    if not sys.platform.startswith("linux"):
        return [""]
    wanted = "glfw" if wanted == "glx" else wanted
    if wanted not in (*_BACKENDS, *_ANY):
        _warn(f"MUJOCO_GL is '{value}', which is not a known backend; valid: {_VALID}")
    first = wanted if wanted in _BACKENDS else os.environ.get("PYOPENGL_PLATFORM", "").lower()
    return sorted(_BACKENDS, key=lambda backend: backend != first)


def environment(backend: str) -> dict[str, str]:
    """Return the environment for a process that renders with a backend."""
    env = {name: text for name, text in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    if backend:
        env["MUJOCO_GL"] = backend
    return env | ({"PYOPENGL_PLATFORM": backend} if backend in _LIBRARIES else {})


def note_failures(reasons: Mapping[str, str], used: str) -> None:
    """Warn once if the backend that MUJOCO_GL names failed and ``used`` replaces it."""
    wanted = os.environ.get(_HIDDEN, os.environ.get("MUJOCO_GL", "")).lower().strip()
    if wanted in reasons:
        _warn(f"MUJOCO_GL={wanted} does not work here ({reasons[wanted]}); drawing with {used}")


def no_opengl(reasons: Mapping[str, str]) -> RenderError:
    """Return the error for a machine on which no backend works, given each backend's reason."""
    listed = "; ".join(f"{name or sys.platform}: {reason}" for name, reason in reasons.items())
    return RenderError(f"no OpenGL to render with ({listed}); {CURE}")


@functools.cache
def context_class() -> type[Any]:
    """Return MuJoCo's OpenGL context class for the first of `backends` that works here.

    Each backend is tried in a child process: PyOpenGL binds permanently to a backend when it is
    first imported, and a broken driver must not crash this process.

    Raises:
        RenderError: if none works; the message names the packages to install.
    """
    tried = backends()
    # Mesa's software renderer and triton, torch's GPU compiler, both bundle LLVM. Loading triton
    # after Mesa crashes the process (Mesa 22.3, triton 3.9); loading it first works.
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")
    reasons: dict[str, str] = {}
    for backend in tried:
        reason = _why_not(backend)
        if reason is None:
            note_failures(reasons, backend)
            _log.debug("rendering with %s", backend)
            return importlib.import_module(f"mujoco.{backend or 'gl_context'}").GLContext
        reasons[backend] = reason
    raise no_opengl(reasons)


def _why_not(backend: str) -> str | None:
    """Return why a backend cannot be used in this process, or None if it renders."""
    platform = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    if backend in _LIBRARIES and platform not in ("", backend):
        return f"PYOPENGL_PLATFORM={platform} excludes it"
    if reason := _missing(backend):
        return reason
    command = [sys.executable, "-c", _PROBE]
    try:
        done = subprocess.run(
            command,
            env=environment(backend),
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "it hangs"
    return None if done.returncode == 0 else why_ended(done.returncode, done.stderr)


def why_ended(code: int, stderr: str) -> str:
    """Return in a few words why a rendering process failed."""
    lines = stderr.strip().splitlines()
    if code < 0:
        return f"its driver crashed (signal {-code})"
    return lines[-1].removeprefix("pgdm.errors.RenderError: ") if lines else f"exit code {code}"


def _missing(backend: str) -> str | None:
    """Return that the system library of a backend is not installed, or None if it is."""
    if backend not in _LIBRARIES:
        return None
    try:
        ctypes.CDLL(_LIBRARIES[backend])
    except OSError:
        return f"{_LIBRARIES[backend]} is not installed"
    return None


@functools.cache
def _warn(sentence: str) -> None:
    _log.warning(sentence)
