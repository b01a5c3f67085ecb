"""Where an episode starts: the pre-grasp as stored, in its several forms, or the reset pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion, Start, pregrasp_file
from pgdm.sim.scene import Scene

SOURCES = ("planned", "mined", "mocap", "teleop", "labeled", "learned", "none")

LIMIT_TOLERANCE = 0.5
"""By how much, m or rad, a joint of the user's own start may be beyond its limits: recordings do
not stop at them, and published pre-grasps leave theirs by up to 0.46 rad."""
_CURES = {
    "planned": "Stored plans come with a TCDM checkout (pgdm assets import PATH); 'pgdm pregrasp "
    "reach {0}' makes one",
    "mined": "'pgdm pregrasp --help' lists how to make others",
    "mocap": "'pgdm pregrasp mocap {0} --hand {1}' makes one",
    "teleop": "'pgdm pregrasp teleop {0} FILE' cuts one from a demonstration",
    "labeled": "'pgdm pregrasp label {0} --hand {1}' opens a page to pose one",
    "learned": "It is made by itself after 'pgdm pregrasp train --hand {1}'",
}


@dataclass(frozen=True)
class PregraspCfg:
    """Which start state to use (SPEC 1 and 2)."""

    source: str
    """``planned``: state after the reach planner moved the hand to its pre-grasp; ``mined``: the
    pre-grasp as found, kinematic; ``mocap``: from a human hand's joints, by inverse kinematics;
    ``teleop``: cut from a demonstration; ``labeled``: posed by a person; ``learned``: as a
    mesh-conditioned model predicted it; ``none``: the hand's reset pose, all joints zero. The
    user's own pre-grasp of a source goes before one that is stored with the motion."""
    fallback: str | None
    """Source to take where this one is not stored for a task, or None: then it is an error. The
    asset library that the program fetches has no plans, only mined pre-grasps."""


@dataclass(frozen=True)
class ReachStart:
    """A plan that brings the hand to a start state, and where it begins."""

    qpos: np.ndarray  # (nq,) m, rad: the hand in its reset pose, at rest
    actions: np.ndarray  # (K, nu) in [-1, 1]


@dataclass(frozen=True)
class StartState:
    """State in which every episode of a task begins."""

    source: str  # where it came from, which may be the fallback
    qpos: np.ndarray  # (nq,) m, rad
    qvel: np.ndarray  # (nv,) m/s, rad/s
    sha256: str = ""  # of the file, if it is the user's own
    reach: ReachStart | None = None  # what leads here, if a plan is stored


def start_state(cfg: PregraspCfg, motion: Motion, scene: Scene) -> StartState:
    """Return the start state of a task.

    With ``none`` the object stands where the stored pre-grasp has it (SPEC 3).

    Raises:
        ConfigError: if the source is unknown, there is none for this task, or what there is does
            not fit the scene's joints.
    """
    if cfg.source not in SOURCES:
        raise ConfigError(f"pregrasp.source '{cfg.source}' is unknown; valid: {', '.join(SOURCES)}")
    if cfg.source == "none":
        return _reset_pose(motion, scene)
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
    """Return the source or its fallback, whichever is stored first; None if neither is."""
    for source in (cfg.source, cfg.fallback):
        if source is not None and (
            source in motion.starts or pregrasp_file.path_of(task, hand, source).is_file()
        ):
            return source
    return None


def _stored(source: str, motion: Motion, scene: Scene) -> StartState:
    """Return the user's own start of a source, else the one that is stored with the motion."""
    task, hand = scene.task.id, scene.hand.name
    own = pregrasp_file.find(task, hand, source)
    if own is not None:
        reach = _reach(own.start, own.pose.qpos, scene)
        start = StartState(source, own.start.qpos, own.start.qvel, own.sha256, reach)
        return _within_limits(_fitting(start, scene), scene)
    stored = motion.starts[source]
    # The plans of R begin with the objects where the mined pre-grasp has them.
    mined = motion.starts.get("mined", stored)
    reach = _reach(stored, mined.qpos, scene)
    start = StartState(source, np.array(stored.qpos), np.array(stored.qvel), reach=reach)
    return _fitting(start, scene)


def _reach(start: Start, pose: np.ndarray, scene: Scene) -> ReachStart | None:
    """Return the plan of a stored start, which begins with the objects where a pose has them."""
    if start.actions is None or start.actions.shape[1] != scene.model.nu:
        return None
    home = np.array(pose)
    home[: scene.model.nu] = 0.0
    return ReachStart(home, np.array(start.actions))


def no_plan(source: str, scene: Scene) -> str:
    """Return what to tell who wants to see a reach that nobody planned."""
    return (
        f"no plan leads to the start '{source}' of task '{scene.task.id}' with hand "
        f"'{scene.hand.name}'; make one with 'pgdm pregrasp reach {scene.task.id}' (ablated starts "
        "and reset poses have none)"
    )


def _reset_pose(motion: Motion, scene: Scene) -> StartState:
    if "mined" not in motion.starts:
        raise ConfigError(f"motion '{motion.id}' does not store where its objects start")
    # Only the objects' joints, last in qpos, are taken: the hand may be another than the stored
    # start's.
    stored, model = motion.starts["mined"].qpos, scene.model
    objects = stored[len(stored) - (model.nq - model.nu) :]
    qpos = np.concatenate((np.zeros(model.nu), objects))
    return _fitting(StartState("none", qpos, np.zeros(model.nv)), scene)


def _within_limits(start: StartState, scene: Scene) -> StartState:
    """Return a start of the user's own if the hand can be where it says."""
    model, hand = scene.model, start.qpos[: scene.model.nu]
    low, high = model.jnt_range[: model.nu].T
    beyond = np.maximum(low - hand, hand - high)
    worst = int(beyond.argmax())
    if beyond[worst] > LIMIT_TOLERANCE:
        path = pregrasp_file.path_of(scene.task.id, scene.hand.name, start.source)
        raise ConfigError(
            f"{path}: joint {model.joint(worst).name} is at {hand[worst]:.3f}, its limits are "
            f"{low[worst]:.3f} to {high[worst]:.3f} (m or rad); make the pre-grasp anew"
        )
    return start


def _fitting(start: StartState, scene: Scene) -> StartState:
    model = scene.model
    if start.qpos.shape != (model.nq,) or start.qvel.shape != (model.nv,):
        raise ConfigError(
            f"start '{start.source}' of task '{scene.task.id}' has {start.qpos.size} positions and "
            f"{start.qvel.size} velocities, the scene with hand '{scene.hand.name}' has "
            f"{model.nq} and {model.nv}; pregrasp=planned makes one for another hand, "
            "pregrasp=none starts from its reset pose"
        )
    return start
