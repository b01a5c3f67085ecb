"""The 3D scene on the labeler's page: moving bodies, warning colours, handles to drag."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import viser

from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.pregrasp.labeler.measures import Metrics
from pgdm.pregrasp.labeler.shapes import Shape
from pgdm.sim.camera import camera_for
from pgdm.sim.scene import Scene

INSIDE_RGB = (222, 45, 38)
"""Colour of links that penetrate something."""
_STILL = 1e-7  # change of position (m) or quaternion below which a pose is not sent again
_ASPECT = 1.2  # aspect ratio of the part of the page that shows the scene
_NEARER = 0.85  # camera distance relative to that in videos: the forearm need not be in view
_WRIST_SCALE, _TIP_SCALE = 0.11, 0.04  # m, size of the handles

OnWrist = Callable[[np.ndarray, np.ndarray, str], None]
"""Called with the wrist handle's position (3,) m, orientation (4,) wxyz, and the drag's phase
(start, update, end)."""
OnTip = Callable[[int, np.ndarray, str], None]
"""Called with the finger's index, its handle's position (3,) m, and the drag's phase."""


class Stage:
    """Draws the scene, shared by all open pages.

    Args:
        server: the labeler's server.
        scene: scene to draw.
        kinematics: kinematics of the scene.
        looks: visible shapes.
        solid: collision shapes.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scene: Scene,
        kinematics: Kinematics,
        looks: Sequence[Shape],
        solid: Sequence[Shape],
    ) -> None:
        self._scene_api, self._scene, self._kinematics = server.scene, scene, kinematics
        self._frames: dict[int, viser.FrameHandle] = {}
        self._parts: dict[int, list[tuple[viser.MeshHandle, tuple[int, int, int]]]] = {}
        self._solid: list[viser.MeshHandle] = []
        self._inside: frozenset[int] = frozenset()
        self._lights()
        for number, shape in enumerate(looks):
            name = f"{self._frame(shape.body)}/{number}"
            mesh = self._mesh(name, shape, None)
            self._parts.setdefault(shape.body, []).append((mesh, shape.rgb))
        for shape in solid:
            mesh = self._mesh(f"{self._frame(shape.body)}/solid", shape, 0.45)
            mesh.visible = False
            self._solid.append(mesh)
        self.wrist = self._scene_api.add_transform_controls(
            "/handles/wrist", scale=_WRIST_SCALE, line_width=3.0, depth_test=False, opacity=0.85
        )
        self.tips = [self._tip(finger.name) for finger in kinematics.fingers]

    def on_drag(self, wrist: OnWrist, tip: OnTip) -> None:
        """Call the functions when handles are dragged, in the order of the events."""

        async def wrist_moved(event: viser.TransformControlsEvent) -> None:
            handle = event.target
            wrist(np.array(handle.position), np.array(handle.wxyz), event.phase)

        self.wrist.on_update(wrist_moved)
        for finger, handle in enumerate(self.tips):

            async def tip_moved(event: viser.TransformControlsEvent, finger: int = finger) -> None:
                tip(finger, np.array(event.target.position), event.phase)

            handle.on_update(tip_moved)

    def aim(self, server: viser.ViserServer, qpos: np.ndarray) -> None:
        """Set the initial camera of new pages: hand and object in view, unobstructed."""
        model, index = self._scene.model, self._scene.index
        data = self._kinematics.forward(qpos)
        hand = data.geom_xpos[index.point_geoms]
        shown = np.concatenate((hand, data.xipos[[index.object_body]]))
        camera = camera_for(model, data, index.object_body, shown, _ASPECT)
        around, up = math.radians(camera.azimuth), math.radians(camera.elevation)
        forward = np.array(
            [math.cos(around) * math.cos(up), math.sin(around) * math.cos(up), math.sin(up)]
        )
        spot = shown.mean(axis=0)
        server.initial_camera.look_at = tuple(spot)
        server.initial_camera.position = tuple(spot - _NEARER * camera.distance * forward)
        server.initial_camera.fov = math.radians(float(model.vis.global_.fovy))
        server.initial_camera.near = 0.01

    def pose(self, qpos: np.ndarray) -> None:
        """Move the bodies to qpos (nq,)."""
        data = self._kinematics.forward(qpos)
        for body, frame in self._frames.items():
            if np.abs(frame.position - data.xpos[body]).max() > _STILL:
                frame.position = data.xpos[body]
            if np.abs(frame.wxyz - data.xquat[body]).max() > _STILL:
                frame.wxyz = data.xquat[body]

    def handles(self, qpos: np.ndarray, dragged: object) -> None:
        """Move the handles to the wrist and fingertips, except the handle being dragged.

        Args:
            qpos: the pose (nq,).
            dragged: ``wrist``, the index of a finger, or None.
        """
        pos, quat = self._kinematics.wrist_pose(qpos)
        if dragged != "wrist":
            _place(self.wrist, pos, quat)
        data = self._kinematics.data
        for finger, handle in enumerate(self.tips):
            if finger != dragged:
                _place(handle, data.xpos[self._kinematics.fingers[finger].tip_body], None)

    def warn(self, metrics: Metrics) -> None:
        """Colour the links that penetrate something."""
        for body in self._inside ^ metrics.links:
            for mesh, rgb in self._parts.get(self._drawn(body), []):
                mesh.color = INSIDE_RGB if body in metrics.links else rgb
        self._inside = metrics.links

    def show_handles(self, which: str) -> None:
        """Show handles: ``all``, ``wrist``, ``fingertips`` or ``none``."""
        self.wrist.visible = which in ("all", "wrist")
        for handle in self.tips:
            handle.visible = which in ("all", "fingertips")

    def show_solid(self, shown: bool) -> None:
        """Show or hide the collision shapes."""
        for mesh in self._solid:
            mesh.visible = shown

    def _drawn(self, body: int) -> int:
        """Return a body if it is drawn, else its nearest ancestor that is."""
        while body not in self._parts and body:
            body = int(self._scene.model.body_parentid[body])
        return body

    def _lights(self) -> None:
        scene = self._scene_api
        scene.configure_environment_map("studio", environment_intensity=0.25)
        # viser's shadows are made for whole rooms: at a hand's size they are invisible, but slow.
        scene.configure_default_lights(cast_shadow=False)
        scene.world_axes.visible = False

    def _frame(self, body: int) -> str:
        name = f"/scene/{body}_{self._scene.model.body(body).name.replace('/', '_')}"
        if body not in self._frames:
            self._frames[body] = self._scene_api.add_frame(name, show_axes=False)
        return name

    def _mesh(self, name: str, shape: Shape, opacity: float | None) -> viser.MeshHandle:
        return self._scene_api.add_mesh_simple(
            name,
            shape.vertices,
            shape.faces,
            color=shape.rgb,
            opacity=opacity,
            side="double",
            cast_shadow=opacity is None,
        )

    def _tip(self, name: str) -> viser.TransformControlsHandle:
        return self._scene_api.add_transform_controls(
            f"/handles/{name}",
            scale=_TIP_SCALE,
            line_width=3.0,
            disable_rotations=True,
            disable_sliders=True,
            depth_test=False,
        )


def _place(handle: viser.TransformControlsHandle, pos: np.ndarray, quat: np.ndarray | None) -> None:
    if np.abs(handle.position - pos).max() > _STILL:
        handle.position = pos
    if quat is not None and np.abs(handle.wxyz - quat).max() > _STILL:
        handle.wxyz = quat
