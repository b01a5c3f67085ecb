"""Films: a policy at work, an exemplar motion by itself, and with the expert's hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from pgdm.envs.batch_env import BatchEnv
from pgdm.motion.reference import ObjectReference
from pgdm.sim.render import Renderer, write_image, write_video
from pgdm.sim.replay import motion_qpos
from pgdm.sim.scene import Scene
from pgdm.wrist.plan import WristPlan

_CLOSE_M = 0.4  # height of the picture around the object where contacts are to be seen
LAST_FRAME_REPEATS = 12  # half a second to see how it ended

Act = Callable[[Tensor], Tensor]


def film_policy(env: BatchEnv, act: Act, path: Path) -> Path:
    """Write an MP4 of one episode; return its poster.

    Args:
        env: one simulation, ``auto_reset=False``.
        act: observations (1, D) -> actions (1, A).
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    with _renderer(env.sim.scene, env.mdp.reference) as renderer:
        return write_video(path, _episode(env, act, renderer), round(1 / env.sim.control_dt_s))


def _episode(env: BatchEnv, act: Act, renderer: Renderer) -> Iterator[np.ndarray]:
    obs, done = env.reset(), False
    while True:
        t = int(env.t[0])
        goal = env.mdp.reference.pos[t].numpy(), env.mdp.reference.quat[t].numpy()
        error_cm = 100 * float(env.object_error()[0])
        caption = f"{env.sim.scene.task.id}  step {t}  error {error_cm:.1f} cm"
        frame = renderer.render(env.sim.data(0), goal, caption)
        yield frame
        if done:
            break
        obs, _, terminated, truncated, _ = env.step(act(obs))
        done = bool(terminated[0] or truncated[0])
    for _ in range(LAST_FRAME_REPEATS):
        yield frame


def film_motion(env: BatchEnv, path: Path) -> Path:
    """Write an MP4 of the exemplar motion with the hand at its pre-grasp; return its poster.

    Kinematic: nothing is simulated. Where the followed body has six joints of its own the object
    itself moves, else only its ghost.

    Args:
        env: the task, in any state.
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    scene, reference = env.sim.scene, env.mdp.reference
    qpos = motion_qpos(scene, env.mdp.start.qpos, reference)
    with _renderer(scene, reference) as renderer:
        frames = (
            renderer.render_qpos(
                qpos[t],
                (reference.pos[t].numpy(), reference.quat[t].numpy()),
                f"{scene.task.id}  exemplar motion  {t}/{len(reference) - 1}",
            )
            for t in range(len(reference))
        )
        return write_video(path, frames, round(1 / env.sim.control_dt_s))


def film_reach(env: BatchEnv, qpos: np.ndarray, path: Path) -> Path:
    """Write an MP4 of the way to the pre-grasp; return its poster, where it ends.

    Args:
        env: the task, in any state.
        qpos: joint positions (K+1, nq) at the control steps.
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    scene, last = env.sim.scene, len(qpos) - 1
    with _renderer(scene, env.mdp.reference) as renderer:
        pictures = [
            renderer.render_qpos(row, None, f"{scene.task.id}  reach  {t}/{last}")
            for t, row in enumerate(qpos)
        ]
    held = pictures[-1:] * LAST_FRAME_REPEATS
    poster = write_video(path, [*pictures, *held], round(1 / env.sim.control_dt_s))
    return write_image(poster, pictures[-1])


def film_wrist(env: BatchEnv, plan: WristPlan, path: Path) -> Path:
    """Write an MP4 of the hand alone on its planned way, the goal as a ghost; return its poster.

    Args:
        env: the task, in any state.
        plan: of its wrist.
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    scene, reference = env.sim.scene, env.mdp.reference
    errors_cm = 100 * np.append(0.0, plan.error_m)
    with _renderer(scene, reference) as renderer:
        frames = (
            renderer.render_qpos(
                row,
                (reference.pos[t].numpy(), reference.quat[t].numpy()),
                f"{scene.task.id}  hand alone  step {t}  error {errors_cm[t]:.1f} cm",
            )
            for t, row in enumerate(plan.qpos)
        )
        return write_video(path, frames, round(1 / env.sim.control_dt_s))


def film_expert(
    scene: Scene,
    qpos: np.ndarray,
    marks: Sequence[np.ndarray],
    reference: ObjectReference,
    title: str,
    path: Path,
) -> Path:
    """Write an MP4 of hand and object moving as the expert's did; return its poster.

    Args:
        scene: the task's.
        qpos: joint positions (T, nq) at the control steps.
        marks: where fingers touch the object at each of them, (n, 3) m each, world frame.
        reference: the object's motion, which the picture shows.
        title: what is seen.
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    last = len(qpos) - 1
    with _renderer(scene, reference, _CLOSE_M) as renderer:
        frames = (
            renderer.render_qpos(row, None, f"{scene.task.id}  {title}  {t}/{last}", marks[t])
            for t, row in enumerate(qpos)
        )
        return write_video(path, frames)


def _renderer(scene: Scene, reference: ObjectReference, follow_m: float | None = None) -> Renderer:
    motion = reference.pos.numpy()
    return Renderer(scene.model, scene.index.object_body, motion=motion, follow_m=follow_m)
