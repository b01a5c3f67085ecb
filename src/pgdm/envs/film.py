"""Films: a policy at work, and an exemplar motion by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from pgdm import rotations
from pgdm.envs.batch_env import BatchEnv
from pgdm.motion.reference import ObjectReference
from pgdm.sim.render import Renderer, write_video
from pgdm.sim.scene import Scene

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
    scene = env.sim.scene
    with Renderer(scene.model, scene.index.object_body) as renderer:
        return write_video(path, _episode(env, act, renderer))


def _episode(env: BatchEnv, act: Act, renderer: Renderer) -> Iterator[np.ndarray]:
    obs, done = env.reset(), False
    data = mujoco.MjData(env.sim.scene.model)
    while True:
        t = int(env.t[0])
        goal = env.mdp.reference.pos[t].numpy(), env.mdp.reference.quat[t].numpy()
        error_cm = 100 * float(env.object_error()[0])
        caption = f"{env.sim.scene.task.id}  step {t}  error {error_cm:.1f} cm"
        frame = renderer.render(env.sim.batch.get_data(0, data), goal, caption)
        yield frame
        if done:
            break
        obs, _, terminated, truncated, _ = env.step(act(obs))
        done = bool(terminated[0] or truncated[0])
    for _ in range(LAST_FRAME_REPEATS):
        yield frame


def film_motion(scene: Scene, start: np.ndarray, reference: ObjectReference, path: Path) -> Path:
    """Write an MP4 of the exemplar motion with the hand at its pre-grasp; return its poster.

    Kinematic: nothing is simulated. Where the followed body has six joints of its own the object
    itself moves, else only its ghost.

    Args:
        scene: the task's scene.
        start: qpos (nq,) of the pre-grasp.
        reference: the motion.
        path: of the MP4.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    path_qpos = motion_qpos(scene, start, reference)
    with Renderer(scene.model, scene.index.object_body) as renderer:
        frames = (
            renderer.render_qpos(
                path_qpos[t],
                (reference.pos[t].numpy(), reference.quat[t].numpy()),
                f"{scene.task.id}  exemplar motion  {t}/{len(reference) - 1}",
            )
            for t in range(len(reference))
        )
        return write_video(path, frames)


def motion_qpos(scene: Scene, start: np.ndarray, reference: ObjectReference) -> np.ndarray:
    """Return qpos (T, nq) of the motion: the hand stays at ``start``, the object follows.

    An object without six joints of its own (three slides, then three hinges, as TCDM's) stays.
    """
    model, body = scene.model, scene.index.object_body
    qpos = np.repeat(start[None], len(reference), axis=0)
    first = model.body_jntadr[body]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    kinds = model.jnt_type[first : first + model.body_jntnum[body]].tolist()
    if kinds != [slide] * 3 + [hinge] * 3:
        return qpos
    home_pos = torch.from_numpy(model.body_pos[body].copy())
    home_quat = torch.from_numpy(model.body_quat[body].copy())
    com = torch.from_numpy(model.body_ipos[body].copy())
    origin = reference.pos - rotations.rotate(reference.quat, com.expand_as(reference.pos))
    to_home = rotations.conjugate(home_quat)
    turn = rotations.multiply(to_home, reference.quat)
    at = model.jnt_qposadr[first]
    qpos[:, at : at + 3] = rotations.rotate(to_home, origin - home_pos).numpy()
    qpos[:, at + 3 : at + 6] = rotations.unwrap(rotations.to_euler_xyz(turn)).numpy()
    return qpos
