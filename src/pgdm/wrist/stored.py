"""Stored wrist plans: the first run that needs a plan computes and stores it."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

import numpy as np

from pgdm import paths
from pgdm.errors import CorruptAssetError, LibraryError
from pgdm.library import staging
from pgdm.library.files import npz as safe_npz
from pgdm.library.progress import Notify, StepProgress
from pgdm.wrist.plan import WristPlan, WristProblem, plan_wrist

FILE = "wrist.npz"
"""Name of the copy in a run folder: a policy needs the commands that it was trained on."""
_FOLDER = "wrist"


def path_of(library: Path, problem: WristProblem) -> Path:
    """Return the path of a problem's plan in a library folder; the file may not exist."""
    name = f"{problem.scene.task.id}-{problem.scene.hand.name}-{problem.key()[:16]}"
    return paths.inside(library / _FOLDER, name, suffix=".npz")


class WristPlans:
    """Provides wrist plans: a run's own copy, else the library's, else a newly computed plan.

    Args:
        library: the library's folder.
        run: the run's folder; None without a run.
        notify: called with a sentence when a plan is missing, unusable or computed, when it cannot
            be stored, and when another process is computing it.
        progress: called with the planner's progress; if None, missing plans are not computed.
        num_threads: number of threads of the planner; 0 takes one per core.
    """

    def __init__(
        self,
        library: Path,
        run: Path | None,
        notify: Notify,
        progress: StepProgress | None,
        num_threads: int = 0,
    ) -> None:
        self._library, self._run, self._notify = library, run, notify
        self._progress, self._threads = progress, num_threads

    def __call__(self, problem: WristProblem) -> WristPlan | None:
        """Return a problem's plan; None if it is missing and ``progress`` is None.

        Raises:
            ConfigError: the motion is too short for ``hold_steps``, or too long to plan.
            SceneError: the simulation of the hand diverges.
        """
        problem.check()
        stored, own = path_of(self._library, problem), None
        if self._run is not None:  # valid even if planner or MuJoCo have changed since
            own = self._found(self._run / FILE, problem, any_version=True)
        if (plan := own or self._found(stored, problem)) is not None:
            return plan
        task = problem.scene.task.id
        if self._progress is None:
            self._notify(
                f"no wrist plan of '{task}' is stored yet; the run computes one first (10-40 s)"
            )
            return None
        try:
            with staging.making(stored, self._notify):
                with suppress(CorruptAssetError):  # another process may have computed it meanwhile
                    return read(stored, problem)
                plan = self._plan(problem, self._progress)
                write(stored, plan, problem)
        except LibraryError as error:  # such as a library that belongs to another user
            self._notify(f"{error}; the wrist plan of '{task}' is stored with the run only")
            plan = plan or self._plan(problem, self._progress)
        return plan

    def _plan(self, problem: WristProblem, progress: StepProgress) -> WristPlan:
        task = problem.scene.task.id
        self._notify(f"computing the wrist plan of '{task}' (once; the library stores it)")
        plan = plan_wrist(problem, self._threads, progress)
        self._notify(f"wrist plan of '{task}', {plan.seconds:.0f} s: {plan.described()}")
        return plan

    def _found(
        self, path: Path, problem: WristProblem, any_version: bool = False
    ) -> WristPlan | None:
        try:
            return read(path, problem, any_version) if path.is_file() else None
        except CorruptAssetError as error:
            self._notify(f"{error}; it is not used")
            return None


def write(path: Path, plan: WristPlan, problem: WristProblem) -> None:
    """Write a plan atomically.

    Raises:
        LibraryError: it cannot be written.
    """
    arrays = {"commands": plan.commands, "qpos": plan.qpos, "error_m": plan.error_m}
    arrays["effort"] = np.array([plan.frames, plan.seconds])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, key=_key(problem))  # type: ignore[arg-type]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with paths.replacing(path) as temp:
            temp.write_bytes(buffer.getvalue())
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror or error})") from error


def read(path: Path, problem: WristProblem, any_version: bool = False) -> WristPlan:
    """Read a problem's plan.

    Args:
        path: path of the file.
        problem: the problem that the plan is for.
        any_version: accept any plan of the same length and start state, whatever its hash.

    Raises:
        CorruptAssetError: the file is missing, damaged, for another problem, or, unless
            ``any_version``, from another version of planner or MuJoCo.
    """
    arrays = safe_npz.read_npz(path)
    steps, nq = len(problem.reference) - 1, problem.scene.model.nq
    shapes = {"commands": (steps, 6), "qpos": (steps + 1, nq), "error_m": (steps,), "effort": (2,)}
    for name, shape in shapes.items():
        if not _is_finite(arrays.get(name), shape):
            raise CorruptAssetError(
                f"{path}: '{name}' must be finite float64 numbers of shape {shape}"
            )
    same_start = np.array_equal(arrays["qpos"][0], problem.qpos)
    if not (same_start and (any_version or np.array_equal(arrays.get("key", []), _key(problem)))):
        raise CorruptAssetError(
            f"{path} was computed for another task, hand, start state, hold or load, or with "
            "another version of planner or MuJoCo"
        )
    frames, seconds = arrays["effort"].tolist()
    return WristPlan(arrays["commands"], arrays["qpos"], arrays["error_m"], int(frames), seconds)


def _is_finite(array: object, shape: tuple[int, ...]) -> bool:
    # Other number types are refused, because `WristPlan.sha256` hashes the commands' bytes.
    if not (isinstance(array, np.ndarray) and array.dtype == np.float64):
        return False
    return array.shape == shape and bool(np.isfinite(array).all())


def _key(problem: WristProblem) -> np.ndarray:
    return np.frombuffer(problem.key().encode(), np.uint8)
