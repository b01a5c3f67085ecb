"""Find an OpenGL that draws without a screen."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import logging
import os
import subprocess
import sys
from typing import Any

from pgdm.errors import RenderError

CURE = (
    "install one of the system packages libegl1 (EGL, also with NVIDIA's driver) or libosmesa6 "
    "(software), on Debian and Ubuntu: "
    "apt-get install libegl1 libopengl0 libgl1-mesa-dri libosmesa6"
)
_OFF = ("disable", "disabled", "off", "false", "0")
_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
_PROBE = """
import mujoco
from mujoco.{backend} import GLContext
context = GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50).free()
context.free()
"""
_PROBE_TIMEOUT_S = 60.0

_log = logging.getLogger(__name__)


@functools.cache
def context_class() -> type[Any]:
    """Return MuJoCo's OpenGL context class of the first backend that works here.

    ``MUJOCO_GL`` is obeyed if set. Otherwise, on Linux, EGL and then OSMesa are tried, each in
    a process of its own: PyOpenGL binds to one of them for good when it is first imported, and
    a broken driver must not take the training down with it. Elsewhere MuJoCo's own choice holds.

    Raises:
        RenderError: if none works; names the packages to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _OFF:
        raise RenderError(f"rendering is switched off by MUJOCO_GL={wanted}; unset it to render")
    # Mesa's software renderer brings an LLVM, and so does the compiler that torch has for GPUs:
    # loaded after Mesa's it ends the process (Mesa 22.3, triton 3.9); before it, both work.
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")
    if wanted or not sys.platform.startswith("linux"):
        return _load_mujocos_choice(wanted)
    reasons = []
    for backend in _LIBRARIES:
        reason = _why_not(backend)
        if reason is None:
            _log.debug("rendering with %s", backend)
            return importlib.import_module(f"mujoco.{backend}").GLContext
        reasons.append(f"{backend}: {reason}")
    raise RenderError(f"no OpenGL to render with ({'; '.join(reasons)}); {CURE}")


def _load_mujocos_choice(wanted: str) -> type[Any]:
    """Return the class that MuJoCo itself selected by ``MUJOCO_GL`` at its import."""
    try:
        if wanted in _LIBRARIES:  # also when the variable was set after MuJoCo was imported
            return importlib.import_module(f"mujoco.{wanted}").GLContext
        return importlib.import_module("mujoco.gl_context").GLContext
    except (ImportError, AttributeError, OSError) as error:
        where = f"MUJOCO_GL={wanted}" if wanted else sys.platform
        raise RenderError(f"no OpenGL for {where} ({error}); {CURE}, or unset it") from error


def _why_not(backend: str) -> str | None:
    """Return why a backend cannot be used, or None if it draws."""
    platform = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    if platform and platform != backend:
        return f"PYOPENGL_PLATFORM={platform} excludes it"
    try:
        ctypes.CDLL(_LIBRARIES[backend])
    except OSError:
        return f"{_LIBRARIES[backend]} is not installed"
    command = [sys.executable, "-c", _PROBE.format(backend=backend)]
    env = {**os.environ, "PYOPENGL_PLATFORM": backend}
    try:
        done = subprocess.run(
            command, env=env, capture_output=True, text=True, timeout=_PROBE_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "it hangs"
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return lines[-1]
