"""Poses that the labeler loads and saves, and its draft of the unsaved pose."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from pgdm import paths
from pgdm.errors import ConfigError, CorruptAssetError, RunError, UnknownNameError
from pgdm.library import Motion
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.motion import Start
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp.hand_geometry import mean_fingers
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.pregrasp.sources import reset_state
from pgdm.sim.scene import Scene

SOURCE = "labeled"
"""Pre-grasp source of saved poses."""
PRESETS = ("mined", "planned", "learned", "mocap", "teleop", "labeled", "mean", "open", "none")
"""Names of the poses that can be loaded, besides files."""
DEFAULTS = ("labeled", "planned", "mined", "mocap", "none")
"""By default the labeler starts from the first of these that exists."""
AUTOSAVE_S = 1.0
"""Interval at which the draft is saved. If the labeler is killed, at most the changes since the
last save are lost."""


@dataclass(frozen=True)
class Loaded:
    """A pose to start from."""

    qpos: np.ndarray  # (nq,) m, rad
    origin: str
    """Where the pose comes from, in words."""
    notes: tuple[str, ...] = ()
    """Messages for the user, such as which joints were clipped."""


class Poses:
    """Poses of one task and hand, stored or computed.

    Args:
        scene: scene of the task with the hand to pose.
        motion: motion of the task, with its stored starts.
    """

    def __init__(self, scene: Scene, motion: Motion) -> None:
        self._scene, self._motion = scene, motion
        self._n = scene.index.num_joints
        self._base = reset_state(motion, scene)  # every pose has the objects as here

    def available(self) -> list[str]:
        """Return the presets that exist."""
        return [name for name in PRESETS if name in ("mean", "open", "none") or self._has(name)]

    def first(self) -> Loaded:
        """Return the pose to start from by default."""
        return self.load(next(name for name in DEFAULTS if name == "none" or self._has(name)))

    def load(self, name: str, wrist: np.ndarray | None = None) -> Loaded:
        """Return the pose of a preset or of a file.

        Args:
            name: one of :data:`PRESETS`, or the path of a pre-grasp file.
            wrist: hand joints (n,); only for the presets ``mean`` and ``open``, which keep its base
                and wrist joints and set the fingers. By default the pose of :meth:`first`.

        Raises:
            UnknownNameError: the name is neither a preset nor a path.
            ConfigError: the pose does not exist, or is for another hand or scene.
            CorruptAssetError: a file is damaged.
        """
        if name in ("mean", "open"):
            before = self.first().qpos[: self._n] if wrist is None else wrist
            return self._with(self._fingers(name, before), f"{name} hand")
        if name == "none":
            return self._with(self._scene.index.reset, "reset pose")
        if name in PRESETS:
            return self._stored(name)
        if not (name.endswith(".npz") or "/" in name):
            raise UnknownNameError("pose to start from", name, PRESETS, "Or name a file, *.npz.")
        return self._file(paths.expanded(name))

    def read(self, path: Path, origin: str) -> Loaded:
        """Return the pose of a pre-grasp file.

        Raises:
            ConfigError: the pose is for another hand or scene.
            CorruptAssetError: the file is damaged.
        """
        pregrasp = pregrasp_file.read(path)
        task, hand = self._scene.task.id, self._scene.hand.name
        of_hand, of_task = pregrasp.note.get("hand", hand), pregrasp.note.get("task", task)
        if of_hand != hand:
            raise ConfigError(f"{path} is a pose of hand '{of_hand}', not of '{hand}'")
        notes = () if of_task == task else (f"{path.name} is for task {of_task}",)
        return self._with(self._joints_of(pregrasp.pose.qpos, str(path)), origin, notes)

    def _file(self, path: Path) -> Loaded:
        if not path.is_file():
            raise ConfigError(f"there is no file '{path}'; valid: {', '.join(PRESETS)}, or a file")
        return self.read(path, path.name)

    def _stored(self, name: str) -> Loaded:
        path = pregrasp_file.path_of(self._scene.task.id, self._scene.hand.name, name)
        if path.is_file():
            return self.read(path, f"own {name} pre-grasp")
        if not self._has(name):
            raise ConfigError(
                f"task '{self._scene.task.id}' has no stored pose '{name}' for hand "
                f"'{self._scene.hand.name}'; it has: {', '.join(self.available())}"
            )
        start = self._motion.starts[name]
        return self._with(self._joints_of(start.qpos, f"start '{name}'"), f"{name} pre-grasp")

    def _has(self, name: str) -> bool:
        if name in pregrasp_file.own(self._scene.task.id, self._scene.hand.name):
            return True
        start = self._motion.starts.get(name)
        return start is not None and start.qpos.shape == self._base.shape

    def _joints_of(self, qpos: np.ndarray, label: str) -> np.ndarray:
        if qpos.shape != self._base.shape:
            hand, nq = self._scene.hand.name, self._base.size
            raise ConfigError(
                f"{label} has {qpos.size} positions, the scene with hand '{hand}' has {nq}: it is "
                "for another hand or task"
            )
        return qpos[: self._n]

    def _with(self, joints: np.ndarray, origin: str, notes: tuple[str, ...] = ()) -> Loaded:
        """Return a pose with the given hand joints, clipped to their limits (with a note)."""
        low, high = self._scene.model.jnt_range[: self._n].T
        inside = joints.clip(low, high)
        beyond = np.abs(joints - inside)
        if beyond.max() > 1e-3:  # smaller excesses are rounding errors of the released files
            worst = self._scene.model.joint(int(beyond.argmax())).name
            notes += (
                f"{origin}: joints that exceeded their limits and were clipped: "
                f"{int((beyond > 1e-3).sum())}, {worst} the most, by {beyond.max():.3f} m or rad",
            )
        return Loaded(np.concatenate((inside, self._base[self._n :])), origin, notes)

    def _fingers(self, name: str, before: np.ndarray) -> np.ndarray:
        hand, joints = self._scene.hand, before.copy()
        first = hand.num_base_joints + hand.num_wrist_joints
        joints[first:] = 0.0 if name == "open" else mean_fingers(self._scene)
        return joints


def path(scene: Scene) -> Path:
    """Return the path of a scene's labeled pre-grasp."""
    return pregrasp_file.path_of(scene.task.id, scene.hand.name, SOURCE)


def draft_path(scene: Scene) -> Path:
    """Return the path of the draft."""
    return path(scene).with_name(f"{SOURCE}.draft.npz")


def pregrasp(
    state: LabelState, reached: Start | None, anyway: bool, extra: Mapping[str, Any]
) -> Pregrasp:
    """Return a pose as a pre-grasp, with a note on its origin and quality.

    Args:
        state: the pose.
        reached: final state of a reach to the pose; None without a reach.
        anyway: whether the hand may touch something.
        extra: further entries of the note.

    Raises:
        ConfigError: the hand touches something, and ``anyway`` is false.
    """
    metrics, scene = state.metrics, state.scene
    if not metrics.free and not anyway:
        raise ConfigError(f"not saved: a pre-grasp must touch nothing, but {metrics.reason}")
    note = {
        "task": scene.task.id,
        "hand": scene.hand.name,
        "made_by": "pgdm pregrasp label",
        "depth_m": metrics.depth_m,
        "fingertip_distances_m": [float(d) for d in metrics.tip_distances_m],
        **extra,
    }
    if not metrics.free:
        note["saved_anyway"] = metrics.reason
    return Pregrasp(_still(scene, state.qpos), reached, note)


def _still(scene: Scene, qpos: np.ndarray) -> Start:
    return Start(qpos, np.zeros(scene.model.nv), None)


class Draft:
    """Keeps the unsaved pose in a file, at most a second behind.

    A lock ensures that only one labeler at a time works on a task and hand.

    Args:
        scene: scene of the task with the hand to pose.

    Raises:
        RunError: task and hand are open in another labeler.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._path = scene, draft_path(scene)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self._path.with_name(f".{self._path.stem}.lock"), timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise RunError(
                f"task '{scene.task.id}' with hand '{scene.hand.name}' is open in another labeler; "
                "use its page, or stop it with Ctrl-C"
            ) from None
        self._latest: np.ndarray | None = None
        self._changed, self._guard = threading.Event(), threading.Lock()
        self._ended = False
        self.error: OSError | None = None
        """Error of the last attempt to write the draft; None if it succeeded."""
        self._thread = threading.Thread(target=self._run, name="labeler-draft", daemon=True)
        self._thread.start()

    def found(self, poses: Poses) -> Loaded | None:
        """Return the draft that a previous run of the labeler left, or None.

        If the draft is unusable, rename it and return the default pose with a note that says so.
        """
        if not self._path.is_file():
            return None
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(self._path.stat().st_mtime))
        try:
            return poses.read(self._path, f"unsaved draft of {when}")
        except (ConfigError, CorruptAssetError) as error:
            aside = self.set_aside()
            loaded = poses.first()
            return replace(loaded, notes=(*loaded.notes, f"{error}; kept as {aside.name}"))

    def set_aside(self) -> Path:
        """Rename the draft that a previous run left, and return its new path, which is unused."""
        aside = paths.unused(self._path.parent, f"{SOURCE}.draft-before", ".npz")
        self._path.replace(aside)
        return aside

    def keep(self, qpos: np.ndarray) -> None:
        """Make a pose (nq,) the draft; it is written within :data:`AUTOSAVE_S`."""
        with self._guard:
            self._latest = qpos
        self._changed.set()

    def drop(self) -> None:
        """Remove the draft, once its pose is saved."""
        with self._guard:
            self._latest = None
            self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Write the last pose, and release the lock."""
        self._ended = True
        self._changed.set()
        self._thread.join()
        self._write()
        self._lock.release()  # the lock file stays: another labeler may already hold it

    def _run(self) -> None:
        while not self._ended:
            self._changed.wait()
            self._changed.clear()
            self._write()
            if not self._ended:
                time.sleep(AUTOSAVE_S)

    def _write(self) -> None:
        with self._guard:
            qpos, self._latest = self._latest, None
            if qpos is None:
                return
            note = {"task": self._scene.task.id, "hand": self._scene.hand.name, "draft": True}
            try:
                pregrasp_file.write(self._path, Pregrasp(_still(self._scene, qpos), None, note))
                self.error = None
            except OSError as error:
                self.error = error
