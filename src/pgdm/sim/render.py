"""Images and videos of a scene, with the target as a translucent object, the ghost."""

from __future__ import annotations

import contextlib
import math
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import RenderError
from pgdm.paths import replacing
from pgdm.sim.camera import camera_for
from pgdm.sim.gl import context_class
from pgdm.sim.marks import add_marks

MAX_GEOMS = 2000
GHOST_RGBA = np.array([0.15, 0.95, 0.45, 0.35], np.float32)
HAND_ALPHA = 0.25  # opacity of the hand when marks are shown
# In software OpenGL a 640x480 picture takes 75 ms with the next three settings, 230 ms with the
# scene's own.
SHADOW_SIZE = 1024
SAMPLES = 4
SHADOW_SCALE = 0.1  # share of the light's cone with shadows: enough for the table
VIDEO_FPS = 25  # frames per second, one per control step of 0.04 s: real time


class Renderer:
    """Renders one scene; expensive to construct, so keep it for many images.

    Args:
        model: the compiled scene.
        object_body: id of the tracked body; the ghost shows it and what is rigidly attached to it.
        width: width of the images, pixels.
        height: height of the images, pixels.
        motion: positions of the object's centre of mass to keep in view, (T, 3) m, usually the
            exemplar motion; None: the middle of the table.
        follow_m: height of the world to show with a camera that follows the object, m; None for a
            fixed camera that shows the whole motion.
        opengl: MuJoCo's OpenGL context class; None: that of the first backend that works here.

    Raises:
        RenderError: if no OpenGL works here.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        object_body: int,
        width: int = 640,
        height: int = 480,
        motion: np.ndarray | None = None,
        follow_m: float | None = None,
        opengl: type[Any] | None = None,
    ) -> None:
        self.model, self.width, self.height = model, width, height
        self._object_body = object_body
        self._com = model.body_ipos[object_body].copy()  # (3,) m, COM in the body's frame
        attached = model.body_weldid == model.body_weldid[object_body]
        moves = model.body_weldid != 0
        self._hand_geoms = frozenset(
            np.flatnonzero((moves & ~attached)[model.geom_bodyid]).tolist()
        )
        self._ghost_geoms = frozenset(np.flatnonzero(attached[model.geom_bodyid]).tolist())
        self._data = mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        mujoco.mj_kinematics(model, self._data)
        self._camera = camera_for(model, self._data, object_body, motion, width / height)
        self._follows = follow_m is not None
        if follow_m is not None:
            half_angle = math.radians(model.vis.global_.fovy) / 2
            self._camera.distance = follow_m / 2 / math.tan(half_angle)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._gl, self._mjr = _open(model, width, height, opengl)
        self._free = weakref.finalize(self, _close, self._gl, self._mjr)

    def render(
        self,
        data: mujoco.MjData,
        goal: tuple[np.ndarray, np.ndarray] | None = None,
        caption: str = "",
        marks: np.ndarray | None = None,
    ) -> np.ndarray:
        """Render a state.

        Args:
            data: the state, with current kinematics.
            goal: target of the object: centre of mass (3,) m and orientation (4,) wxyz, world
                frame; None draws no ghost.
            caption: text in the upper left corner.
            marks: points (n, 3) m, world frame, to show as small spheres; the hand is then drawn
                translucent.

        Returns:
            The image, (height, width, 3) uint8.

        Raises:
            RenderError: after ``close``.
        """
        if not self._free.alive:
            raise RenderError("this renderer is closed")
        self._gl.make_current()
        if self._follows:
            self._camera.lookat[:] = data.xipos[self._object_body]
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self.model, data, self._option, None, self._camera, every, self._scene
        )
        for light in self._scene.lights[: self._scene.nlight - 1]:
            light.castshadow = False  # each shadow costs one more pass over the scene
        if goal is not None:
            self._add_ghost(data, *goal)
        if marks is not None:
            self._fade_hand()
            add_marks(self._scene, marks)
        mujoco.mjr_render(self._rect, self._scene, self._mjr)
        if caption:
            font, corner = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
            mujoco.mjr_overlay(font, corner, self._rect, caption, "", self._mjr)
        pixels = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._mjr)
        return pixels[::-1].copy()  # OpenGL's first row is the lowest

    def render_qpos(
        self,
        qpos: np.ndarray,
        goal: tuple[np.ndarray, np.ndarray] | None = None,
        caption: str = "",
        marks: np.ndarray | None = None,
    ) -> np.ndarray:
        """Render joint positions qpos (nq,); otherwise as ``render``."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        return self.render(self._data, goal, caption, marks)

    def look(self, lookat: np.ndarray, distance: float, azimuth: float, elevation: float) -> None:
        """Place the camera at a distance, m, from a point (3,) m; viewing angles in degrees."""
        self._camera.lookat[:], self._camera.distance = lookat, distance
        self._camera.azimuth, self._camera.elevation = azimuth, elevation

    def close(self) -> None:
        """Release OpenGL's resources; may be called twice."""
        self._free()

    def __enter__(self) -> Renderer:
        """Return the renderer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _fade_hand(self) -> None:
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in self._hand_geoms:
                geom.rgba[3] = min(geom.rgba[3], HAND_ALPHA)

    def _add_ghost(self, data: mujoco.MjData, com: np.ndarray, quat: np.ndarray) -> None:
        """Draw the object's visible geoms a second time, at the target."""
        goal_rot = np.empty(9)
        mujoco.mju_quat2Mat(goal_rot, np.asarray(quat, float))
        goal_rot = goal_rot.reshape(3, 3)
        goal_pos = np.asarray(com, float) - goal_rot @ self._com  # the target is a pose of the COM
        rotation = goal_rot @ data.xmat[self._object_body].reshape(3, 3).T
        start = data.xpos[self._object_body]
        kind = mujoco.mjtObj.mjOBJ_GEOM
        shown = [
            geom
            for geom in self._scene.geoms[: self._scene.ngeom]
            if geom.objtype == kind and geom.objid in self._ghost_geoms
        ]
        for geom in shown[: self._scene.maxgeom - self._scene.ngeom]:
            ghost = self._scene.geoms[self._scene.ngeom]
            pos = goal_pos + rotation @ (geom.pos - start)
            mat = (rotation @ geom.mat).ravel()
            mujoco.mjv_initGeom(ghost, geom.type, geom.size, pos, mat, GHOST_RGBA)
            ghost.size[:] = geom.size  # mjv_initGeom has converted the size a second time
            ghost.dataid = geom.dataid
            ghost.category = mujoco.mjtCatBit.mjCAT_DECOR
            self._scene.ngeom += 1


def _open(
    model: mujoco.MjModel, width: int, height: int, opengl: type[Any] | None
) -> tuple[Any, mujoco.MjrContext]:
    """Create the OpenGL context and upload the scene's meshes and textures."""
    try:
        context = (opengl or context_class())(width, height)
        context.make_current()
    except (ImportError, RuntimeError, AttributeError, OSError) as error:
        raise RenderError(f"OpenGL does not start: {error}") from error
    with _drawn_cheaply(model, width, height):
        try:
            resources = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:
            raise RenderError(f"OpenGL does not start: {error}") from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, resources)
    return context, resources


@contextlib.contextmanager
def _drawn_cheaply(model: mujoco.MjModel, width: int, height: int) -> Iterator[None]:
    """Replace a model's visual settings while MuJoCo reads them; the physics is unaffected.

    The off-screen buffer that the scene asks for, 3024x1680 with 8 samples, takes 300 MB in
    software OpenGL.
    """
    glob, quality, maps = model.vis.global_, model.vis.quality, model.vis.map
    before = glob.offwidth, glob.offheight, quality.offsamples, quality.shadowsize, maps.shadowscale
    glob.offwidth, glob.offheight = width, height
    quality.offsamples, quality.shadowsize, maps.shadowscale = SAMPLES, SHADOW_SIZE, SHADOW_SCALE
    try:
        yield
    finally:
        glob.offwidth, glob.offheight, quality.offsamples, quality.shadowsize = before[:4]
        maps.shadowscale = before[4]


def _close(context: Any, resources: mujoco.MjrContext) -> None:
    with context.as_current():
        resources.free()
    context.free()


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int = VIDEO_FPS) -> Path:
    """Write an MP4 (H.264, yuv420p: plays in every browser) and its poster image.

    Args:
        path: path of the MP4; it appears only when complete, and replaces an older one.
        frames: images (H, W, 3) uint8 of equal size, at least one. Odd sizes lose their last row or
            column.
        fps: frames per second.

    Returns:
        Path of the poster, ``path`` with suffix ``.png``: the frame in the middle of the video.

    Raises:
        RenderError: if there are no frames or the file cannot be written.
    """
    import imageio_ffmpeg

    pictures = [_even(frame) for frame in frames]
    if not pictures:
        raise RenderError(f"no frames for {path}")
    height, width = pictures[0].shape[:2]
    with _replacing(path) as temp:
        writer = imageio_ffmpeg.write_frames(
            str(temp),
            (width, height),
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"],
            ffmpeg_log_level="error",
        )
        with contextlib.closing(writer):
            writer.send(None)
            for picture in pictures:
                writer.send(picture)
    return write_image(path.with_suffix(".png"), pictures[len(pictures) // 2])


def write_image(path: Path, picture: np.ndarray) -> Path:
    """Write an image (H, W, 3) uint8 as PNG, atomically.

    Raises:
        RenderError: if the file cannot be written.
    """
    from PIL import Image

    with _replacing(path) as temp:
        Image.fromarray(picture).save(temp, format="png")
    return path


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which then replaces ``path`` atomically."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temp:
            temp.touch()  # detects an unwritable folder before ffmpeg starts
            yield temp
    except (OSError, RuntimeError) as error:
        raise RenderError(f"cannot write {path}: {error}") from error


def _even(frame: np.ndarray) -> np.ndarray:
    height, width = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
    return np.ascontiguousarray(frame[:height, :width])
