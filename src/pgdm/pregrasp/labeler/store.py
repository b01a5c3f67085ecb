"""Where a pose comes from when the labeler starts, and where it is kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from pgdm.errors import ConfigError, CorruptAssetError, RunError, UnknownNameError
from pgdm.library import Motion, pregrasp_file
from pgdm.library.motion_file import Start
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.pregrasp.sources import PregraspCfg, start_state
from pgdm.sim.scene import Scene

SOURCE = "labeled"
"""Name of the source that saved poses belong to."""
PRESETS = ("mined", "planned", "learned", "mocap", "teleop", "labeled", "mean", "open", "none")
"""What a pose can be made of, besides a file."""
DEFAULTS = ("labeled", "planned", "mined", "mocap", "none")
"""Where the labeler starts if nobody says: the first of these that there is."""
AUTOSAVE_S = 1.0
"""A killed labeler loses no more than this."""


@dataclass(frozen=True)
class Loaded:
    """A pose to start from."""

    qpos: np.ndarray  # (nq,) m, rad
    origin: str
    """Where it is from, in words."""
    notes: tuple[str, ...] = ()
    """What was repaired, or should be known."""


class Poses:
    """Poses of one task and hand: those that are stored, and those that can be computed.

    Args:
        scene: the task's, with the hand.
        motion: the task's, with its stored starts.
    """

    def __init__(self, scene: Scene, motion: Motion) -> None:
        self._scene, self._motion = scene, motion
        self._nu = scene.model.nu
        # The objects stand where they stand without a pre-grasp, whatever the hand.
        self._base = start_state(PregraspCfg("none", None), motion, scene).qpos

    def available(self) -> list[str]:
        """Return which presets there are."""
        return [name for name in PRESETS if name in ("mean", "open", "none") or self._has(name)]

    def first(self) -> Loaded:
        """Return the pose to start from if nobody says."""
        return self.load(next(name for name in DEFAULTS if name == "none" or self._has(name)))

    def load(self, name: str, wrist: np.ndarray | None = None) -> Loaded:
        """Return a pose by a preset's name, or from a file.

        Args:
            name: of :data:`PRESETS`, or a pre-grasp's file.
            wrist: joints (nu,) whose wrist the presets ``mean`` and ``open`` keep; by default
                those of the pose that the labeler would start from.

        Raises:
            ConfigError: there is no such pose, or it belongs to another hand or scene.
            CorruptAssetError: a file is damaged.
        """
        if name in ("mean", "open"):
            before = self.first().qpos[: self._nu] if wrist is None else wrist
            return self._with(self._fingers(name, before), f"{name} hand")
        if name == "none":
            return self._with(np.zeros(self._nu), "reset pose")
        if name in PRESETS:
            return self._stored(name)
        if not (name.endswith(".npz") or "/" in name):
            raise UnknownNameError("pose to start from", name, PRESETS, "Or name a file, *.npz.")
        return self._file(Path(name).expanduser())

    def read(self, path: Path, origin: str) -> Loaded:
        """Return the pose of a pre-grasp's file.

        Raises:
            ConfigError: it belongs to another hand or scene.
            CorruptAssetError: it is damaged.
        """
        pregrasp = pregrasp_file.read(path)
        task, hand = self._scene.task.id, self._scene.hand.name
        of_hand, of_task = pregrasp.note.get("hand", hand), pregrasp.note.get("task", task)
        if of_hand != hand:
            raise ConfigError(f"{path} is a pose of hand '{of_hand}', not of '{hand}'")
        notes = () if of_task == task else (f"{path.name} was made for task {of_task}",)
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
                f"{label} has {qpos.size} positions, the scene with hand '{hand}' has {nq}: it "
                "belongs to another hand or task"
            )
        return qpos[: self._nu]

    def _with(self, joints: np.ndarray, origin: str, notes: tuple[str, ...] = ()) -> Loaded:
        """Return a pose with the hand's joints, set to their limits where they are beyond."""
        low, high = self._scene.model.jnt_range[: self._nu].T
        inside = joints.clip(low, high)
        beyond = np.abs(joints - inside)
        # The released files are rounded.
        if beyond.max() > 1e-3:
            worst = self._scene.model.joint(int(beyond.argmax())).name
            notes += (
                f"{int((beyond > 1e-3).sum())} joints of the {origin} were beyond their limits "
                f"and are set to them; furthest {worst}, by {beyond.max():.3f} m or rad",
            )
        return Loaded(np.concatenate((inside, self._base[self._nu :])), origin, notes)

    def _fingers(self, name: str, before: np.ndarray) -> np.ndarray:
        hand, joints = self._scene.hand, before.copy()
        first = hand.num_base_joints + hand.num_wrist_joints
        if name == "open":
            joints[first:] = 0.0
            return joints
        if len(hand.mean_fingers_rad) != self._nu - first:
            raise ConfigError(
                f"hand.mean_fingers_rad has {len(hand.mean_fingers_rad)} numbers, but hand "
                f"'{hand.name}' has {self._nu - first} finger joints"
            )
        joints[first:] = hand.mean_fingers_rad
        return joints


def path(scene: Scene) -> Path:
    """Return where a scene's labeled pre-grasp lies."""
    return pregrasp_file.path_of(scene.task.id, scene.hand.name, SOURCE)


def draft_path(scene: Scene) -> Path:
    """Return where the pose that is not saved yet is kept."""
    return path(scene).with_name(f"{SOURCE}.draft.npz")


def pregrasp(
    state: LabelState, reached: Start | None, anyway: bool, extra: Mapping[str, Any]
) -> Pregrasp:
    """Return the pre-grasp of a pose, with all that should be known of it.

    Raises:
        ConfigError: the hand touches something, and it was not said to be saved anyway.
    """
    figures, scene = state.figures, state.scene
    if not figures.free and not anyway:
        raise ConfigError(f"not saved: a pre-grasp touches nothing, but {figures.reason}")
    note = {
        "task": scene.task.id,
        "hand": scene.hand.name,
        "made_by": "pgdm pregrasp label",
        "depth_m": figures.depth_m,
        "fingertip_distances_m": [float(d) for d in figures.tip_distances_m],
        **extra,
    }
    if not figures.free:
        note["saved_anyway"] = figures.reason
    return Pregrasp(_still(scene, state.qpos), reached, note)


def _still(scene: Scene, qpos: np.ndarray) -> Start:
    return Start(qpos, np.zeros(scene.model.nv), None)


class Draft:
    """Keeps the pose that is being made, at most a second behind, in a file of its own.

    Only one labeler at a time works on a task and hand.

    Args:
        scene: the task's, with the hand.

    Raises:
        RunError: another labeler has it.
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
                "use its page, or end it with Ctrl-C"
            ) from None
        self._latest: np.ndarray | None = None
        self._changed, self._guard = threading.Event(), threading.Lock()
        self._ended = False
        self.error: OSError | None = None
        """What kept the last draft from being written."""
        self._thread = threading.Thread(target=self._run, name="labeler-draft", daemon=True)
        self._thread.start()

    def found(self, poses: Poses) -> Loaded | None:
        """Return the draft of an earlier labeler; a damaged one is set aside, and said to be."""
        if not self._path.is_file():
            return None
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(self._path.stat().st_mtime))
        try:
            return poses.read(self._path, f"draft of {when}, not saved then")
        except (ConfigError, CorruptAssetError) as error:
            aside = self.set_aside()
            loaded = poses.first()
            return Loaded(
                loaded.qpos, loaded.origin, (*loaded.notes, f"{error}; kept as {aside.name}")
            )

    def set_aside(self) -> Path:
        """Give the draft of an earlier labeler another name, and return it."""
        aside = self._path.with_name(f"{SOURCE}.draft-before.npz")
        self._path.replace(aside)
        return aside

    def keep(self, qpos: np.ndarray) -> None:
        """Have a pose (nq,) written, unless a later one is first."""
        with self._guard:
            self._latest = qpos
        self._changed.set()

    def drop(self) -> None:
        """Remove the draft: its pose is saved."""
        with self._guard:
            self._latest = None
            self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Write what is not written yet, and let others in."""
        self._ended = True
        self._changed.set()
        self._thread.join()
        self._write()
        self._lock.release()  # its file stays: who waits for it holds it by now

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
