"""Start states of episodes: the stored pre-grasp of a source, or the hand's reset pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion, Start
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.sim.scene import Scene

SOURCES = ("planned", "mined", "mocap", "teleop", "labeled", "learned", "none")

LIMIT_TOLERANCE = 0.5
"""How far, m or rad, a joint of the user's own pre-grasp may exceed its limits. Not zero, because
recordings ignore limits, and even mined pre-grasps exceed them by up to 0.46 rad."""
_CURES = {
    "planned": "Stored plans come with a TCDM checkout (pgdm assets import PATH); 'pgdm pregrasp "
    "reach {0}' computes one",
    "mined": "'pgdm pregrasp --help' lists how to create others",
    "mocap": "'pgdm pregrasp mocap {0} --hand {1}' computes one",
    "teleop": "'pgdm pregrasp teleop {0} FILE' cuts one from a demonstration",
    "labeled": "'pgdm pregrasp label {0} --hand {1}' opens a page to pose one",
    "learned": "It is predicted automatically after 'pgdm pregrasp train --hand {1}'",
}


@dataclass(frozen=True)
class PregraspCfg:
    """Which start state to use."""

    source: str
    """``planned``: state in which the reach plan leaves the hand; ``mined``: pre-grasp published
    with the task, set kinematically; ``mocap``: from a human hand's joints, by inverse kinematics;
    ``teleop``: cut from a demonstration; ``labeled``: posed by a person; ``learned``: predicted
    from the object's shape; ``none``: the hand's reset pose. The user's own pre-grasp of a source
    takes precedence over the one stored with the motion."""
    fallback: str | None
    """Source to use if ``source`` is not stored for a task; None makes that an error. The assets
    that pgdm downloads contain no plans, only mined pre-grasps."""


@dataclass(frozen=True)
class ReachStart:
    """The reach plan that ends in a start state."""

    qpos: np.ndarray  # (nq,) m, rad: where the plan begins, the hand at rest in its reset pose
    actions: np.ndarray  # (K, nu) in [-1, 1]


@dataclass(frozen=True)
class StartState:
    """State in which every episode of a task starts."""

    source: str  # the pre-grasp source that was used, perhaps the fallback
    qpos: np.ndarray  # (nq,) m, rad
    qvel: np.ndarray  # (nv,) m/s, rad/s
    sha256: str = ""  # of the user's own pre-grasp file; empty for other starts
    reach: ReachStart | None = None  # the plan that ends here, if one is stored


def start_state(cfg: PregraspCfg, motion: Motion, scene: Scene) -> StartState:
    """Return the start state of a task.

    With ``none`` the objects are where the mined pre-grasp has them; if there is no mined one,
    where the motion's first stored start has them.

    Raises:
        ConfigError: the source is unknown or not stored for this task, or the stored state does
            not fit the scene's joints or their limits.
        CorruptAssetError: the file of the user's own pre-grasp is damaged.
    """
    if cfg.source not in SOURCES:
        raise ConfigError(f"pregrasp.source '{cfg.source}' is unknown; valid: {', '.join(SOURCES)}")
    if cfg.source == "none":
        still = np.zeros(scene.model.nv)
        return _fitting(StartState("none", reset_state(motion, scene), still), scene)
    task, hand = scene.task.id, scene.hand.name
    source = stored_source(cfg, motion, task, hand)
    if source is not None:
        return _stored(source, motion, scene)
    have = [*motion.starts, *pregrasp_file.own(task, hand)]
    raise ConfigError(
        f"task '{task}' has no stored start '{cfg.source}' for hand '{hand}'; it has: "
        f"{', '.join(sorted(set(have)))} (pregrasp=...). {_CURES[cfg.source].format(task, hand)}"
    )


def stored_source(cfg: PregraspCfg, motion: Motion, task: str, hand: str) -> str | None:
    """Return the configured source if stored, else the fallback if stored, else None."""
    for source in (cfg.source, cfg.fallback):
        if source is not None and (
            source in motion.starts or pregrasp_file.path_of(task, hand, source).is_file()
        ):
            return source
    return None


def _stored(source: str, motion: Motion, scene: Scene) -> StartState:
    """Return the start state from the user's own pre-grasp, else from the motion's."""
    task, hand = scene.task.id, scene.hand.name
    own = pregrasp_file.find(task, hand, source)
    if own is not None:
        reach = _reach(own.start, own.pose.qpos, scene)
        start = StartState(source, own.start.qpos, own.start.qvel, own.sha256, reach)
        return _within_limits(_fitting(start, scene), scene)
    stored = motion.starts[source]
    # The released plans begin with the objects where the mined pre-grasp has them.
    mined = motion.starts.get("mined", stored)
    reach = _reach(stored, mined.qpos, scene)
    start = StartState(source, np.array(stored.qpos), np.array(stored.qvel), reach=reach)
    return _fitting(start, scene)


def _reach(start: Start, pose: np.ndarray, scene: Scene) -> ReachStart | None:
    """Return the plan of a stored start; it begins with the objects as in ``pose`` (nq,).

    Returns None if there is no plan, or if it is for another hand.
    """
    if start.actions is None or start.actions.shape[1] != scene.model.nu:
        return None
    return ReachStart(reset_pose(scene, pose), np.array(start.actions))


def no_plan(source: str, scene: Scene) -> str:
    """Return the message for a start without a reach plan."""
    return (
        f"no plan leads to the start '{source}' of task '{scene.task.id}' with hand "
        f"'{scene.hand.name}'; compute one with 'pgdm pregrasp reach {scene.task.id}' (ablated "
        "starts and reset poses have none)"
    )


def reset_pose(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return qpos (nq,) with the hand in its reset pose: where a reach begins."""
    home = np.array(qpos, float)
    home[: scene.index.num_joints] = scene.index.reset
    return home


def is_reset_pose(scene: Scene, qpos: np.ndarray) -> bool:
    """Return whether qpos (nq,) has the hand in its reset pose, which is not a pre-grasp."""
    return np.array_equal(qpos[: scene.index.num_joints], scene.index.reset)


def object_joints(motion: Motion, scene: Scene) -> np.ndarray:
    """Return the objects' joint positions (nq - n,) at the task's start, for any hand.

    Raises:
        ConfigError: the motion does not store where its objects start.
    """
    stored = motion.starts.get("mined") or next(iter(motion.starts.values()), None)
    if stored is None:
        raise ConfigError(f"motion '{motion.id}' does not store where its objects start")
    return np.array(stored.qpos[len(stored.qpos) - (scene.model.nq - scene.index.num_joints) :])


def reset_state(motion: Motion, scene: Scene) -> np.ndarray:
    """Return qpos (nq,) with the hand in its reset pose and the objects where the task starts.

    Raises:
        ConfigError: the motion does not store where its objects start.
    """
    return np.concatenate((scene.index.reset, object_joints(motion, scene)))


def _within_limits(start: StartState, scene: Scene) -> StartState:
    """Return a start state; raise ConfigError if it exceeds limits by over ``LIMIT_TOLERANCE``."""
    model, count = scene.model, scene.index.num_joints
    hand = start.qpos[:count]
    low, high = model.jnt_range[:count].T
    beyond = np.maximum(low - hand, hand - high)
    worst = int(beyond.argmax())
    if beyond[worst] > LIMIT_TOLERANCE:
        path = pregrasp_file.path_of(scene.task.id, scene.hand.name, start.source)
        raise ConfigError(
            f"{path}: joint {model.joint(worst).name} is at {hand[worst]:.3f}, its limits are "
            f"{low[worst]:.3f} to {high[worst]:.3f} (m or rad); create the pre-grasp again"
        )
    return start


def _fitting(start: StartState, scene: Scene) -> StartState:
    model = scene.model
    if start.qpos.shape != (model.nq,) or start.qvel.shape != (model.nv,):
        raise ConfigError(
            f"start '{start.source}' of task '{scene.task.id}' has {start.qpos.size} positions and "
            f"{start.qvel.size} velocities, the scene with hand '{scene.hand.name}' has "
            f"{model.nq} and {model.nv}; pregrasp=planned computes a start for this hand, "
            "pregrasp=none starts from its reset pose"
        )
    return start
