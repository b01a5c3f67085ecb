"""Videos of a policy's episode and of given states of a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from pgdm.envs.batch_env import BatchEnv
from pgdm.library.progress import StepProgress, silent
from pgdm.motion.reference import ObjectReference
from pgdm.sim.draw import Shots, draw
from pgdm.sim.render import Renderer, write_image, write_video
from pgdm.sim.scene import Scene

_CLOSE_M = 0.4  # height of the picture around the object when contacts are shown
LAST_FRAME_REPEATS = 12  # of the final state: about half a second at 25 frames per second

Act = Callable[[Tensor], Tensor]


def film_policy(env: BatchEnv, act: Act, path: Path) -> Path:
    """Write an MP4 of one episode; return the path of its poster image.

    Args:
        env: one simulation, with ``auto_reset=False``.
        act: observations (1, D) -> actions (1, A).
        path: path of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    scene, rows, captions = env.sim.scene, [], []
    obs, done = env.reset(), False
    while True:
        error_cm = 100 * float(env.object_error()[0])
        captions.append(f"{scene.task.id}  step {int(env.t[0])}  error {error_cm:.1f} cm")
        rows.append(env.sim.data(0).qpos.copy())
        if done:
            break
        obs, _, terminated, truncated, _ = env.step(act(obs))
        done = bool(terminated[0] or truncated[0])
    clip = Clip(scene, env.mdp.reference, np.array(rows), captions, ghost=True)
    pictures = list(_drawn(clip))
    fps = round(1 / env.sim.control_dt_s)
    return write_video(path, [*pictures, *pictures[-1:] * LAST_FRAME_REPEATS], fps)


@dataclass(frozen=True)
class Clip:
    """States of a task's scene at the control steps, to be shown one per frame."""

    scene: Scene
    reference: ObjectReference
    """The exemplar motion, which the camera keeps in view."""
    qpos: np.ndarray  # (K, nq)
    captions: Sequence[str]
    """Text of each frame, (K,)."""
    ghost: bool = False
    """Whether to draw the target as a translucent object."""
    marks: Sequence[np.ndarray] | None = None
    """Points (n, 3) m, world frame, to show as small spheres in each frame, with a camera that
    follows the object."""
    hold: bool = False
    """Whether to repeat the last frame, which is then the poster."""


def film_clip(clip: Clip, fps: int, path: Path, progress: StepProgress = silent) -> Path:
    """Write an MP4 of a clip; return the path of its poster image.

    Args:
        clip: what to show.
        fps: frames per second.
        path: path of the MP4.
        progress: called before OpenGL is opened, after each frame (with the number of frames before
            it), and before the video is encoded.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    pictures = []
    progress("opening OpenGL", 0, 1)
    for picture in _drawn(clip):
        progress("drawing", len(pictures), len(clip.qpos))
        pictures.append(picture)
    progress("encoding", 0, 1)
    held = pictures[-1:] * LAST_FRAME_REPEATS if clip.hold else []
    poster = write_video(path, [*pictures, *held], fps)
    return write_image(poster, pictures[-1]) if clip.hold else poster


def _drawn(clip: Clip) -> Iterator[np.ndarray]:
    """Yield the pictures of a clip, drawn in a child process: a driver crash must not end a run."""
    scene, reference, steps = clip.scene, clip.reference, np.arange(len(clip.qpos))
    shots = Shots(
        scene.model,
        scene.index.object_body,
        reference.pos.numpy(),
        clip.qpos,
        clip.captions,
        goal(reference, steps) if clip.ghost else None,
        clip.marks,
        _CLOSE_M if clip.marks else None,
    )
    return draw(shots)


def renderer(scene: Scene, reference: ObjectReference) -> Renderer:
    """Return a renderer of a scene, in this process, whose camera sees the whole motion."""
    return Renderer(scene.model, scene.index.object_body, motion=reference.pos.numpy())


def goal(reference: ObjectReference, t: int | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return target position (3,) m and orientation (4,) wxyz at step t; for steps (K,), K rows."""
    return reference.pos[t].numpy(), reference.quat[t].numpy()
