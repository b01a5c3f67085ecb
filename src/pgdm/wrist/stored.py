"""Wrist plans kept: each is made once, by the run that needs it first."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from pgdm import paths
from pgdm.errors import CorruptAssetError, LibraryError, PlanMissingError
from pgdm.library import safe_npz, staging
from pgdm.library.report import Progress
from pgdm.wrist.plan import WristPlan, WristProblem, plan_wrist

FILE = "wrist.npz"
"""Name of a run's own copy: a policy goes with the commands that it was trained on."""
_FOLDER = "wrist"
_STEP = "wrist plan"

Notify = Callable[[str], None]


def path_of(library: Path, problem: WristProblem) -> Path:
    """Return where the library in a folder keeps a problem's plan, or would."""
    name = f"{problem.scene.task.id}-{problem.scene.hand.name}-{problem.key()[:16]}.npz"
    return library / _FOLDER / name


class WristPlans:
    """Gives the plan of a problem: a run's own, the library's, or a new one.

    Args:
        library: its folder.
        run: a run's folder, whose copy goes first; None for none.
        notify: told in a sentence what is made, or damaged.
        progress: told how far it is; None: plans that are missing are not made.
        num_threads: 0 takes one per core.
    """

    def __init__(
        self,
        library: Path,
        run: Path | None,
        notify: Notify,
        progress: Progress | None,
        num_threads: int = 0,
    ) -> None:
        self._library, self._run, self._notify = library, run, notify
        self._progress, self._threads = progress, num_threads

    def __call__(self, problem: WristProblem) -> WristPlan:
        """Return a problem's plan.

        Raises:
            ConfigError: the hand's base cannot follow a plan.
            PlanMissingError: it is not there, and is not to be made.
            LibraryError: it cannot be stored.
        """
        problem.check()
        stored = path_of(self._library, problem)
        places = (stored,) if self._run is None else (self._run / FILE, stored)
        for path in places:
            if (plan := self._found(path, problem)) is not None:
                return plan
        task = problem.scene.task.id
        if self._progress is None:
            raise PlanMissingError(f"the wrist of '{task}' is planned first")
        with staging.locked(self._library):
            with suppress(CorruptAssetError):  # another process was first
                return read(stored, problem)
            self._notify(f"the wrist of '{task}' is not planned yet: doing it once")
            progress = self._progress
            plan = plan_wrist(
                problem, self._threads, lambda done, rounds: progress(_STEP, done, rounds)
            )
            write(stored, plan, problem)
        self._notify(
            f"{stored}: in {plan.seconds:.0f} s; the hand alone is "
            f"{1e3 * plan.error_m.mean():.1f} mm off on average, within 1 cm in {plan.bound:.0%} "
            "of the steps"
        )
        return plan

    def _found(self, path: Path, problem: WristProblem) -> WristPlan | None:
        try:
            return read(path, problem) if path.is_file() else None
        except CorruptAssetError as error:
            self._notify(f"{error}; it is not used")
            return None


def write(path: Path, plan: WristPlan, problem: WristProblem) -> None:
    """Write a plan, whole or not at all.

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


def read(path: Path, problem: WristProblem) -> WristPlan:
    """Read a problem's plan.

    Raises:
        CorruptAssetError: the file is missing, damaged, or of another problem.
    """
    arrays = safe_npz.read_npz(path)
    steps, nq = len(problem.reference) - 1, problem.scene.model.nq
    shapes = {"commands": (steps, 6), "qpos": (steps + 1, nq), "error_m": (steps,), "effort": (2,)}
    for name, shape in shapes.items():
        if not _is_finite(arrays.get(name), shape):
            raise CorruptAssetError(f"{path}: '{name}' is not {shape} finite numbers")
    if not np.array_equal(arrays.get("key", []), _key(problem)):
        raise CorruptAssetError(f"{path} is the plan of another task, hand or start")
    frames, seconds = arrays["effort"].tolist()
    return WristPlan(arrays["commands"], arrays["qpos"], arrays["error_m"], int(frames), seconds)


def _is_finite(array: object, shape: tuple[int, ...]) -> bool:
    # Of one type: the hash of the commands is over their bytes.
    if not (isinstance(array, np.ndarray) and array.dtype == np.float64):
        return False
    return array.shape == shape and bool(np.isfinite(array).all())


def _key(problem: WristProblem) -> np.ndarray:
    return np.frombuffer(problem.key().encode(), np.uint8)
