"""``pgdm pregrasp train``: train a predictor on a hand's mined pre-grasps and the user's."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from pgdm.cli.console.progress import duration
from pgdm.cli.console.screen import bars, notify
from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.config.schema import ExperimentCfg
from pgdm.errors import LibraryError, check_name
from pgdm.library import Library, Start, animated, ensure, open_library
from pgdm.library.catalog import CURE
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.progress import StepProgress, counted
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.grasp_vector import GraspFrame
from pgdm.pregrasp.predict.predictor import Example, Predictor, example, fit
from pgdm.pregrasp.sources import is_reset_pose
from pgdm.sim.scene import Scene, build_scene

_OWN = ("labeled", "mocap", "teleop")  # the user's own pre-grasps that come from a person
_FEW_OBJECTS = 10


def run(hand: str, leave_out: Sequence[str], out: Path | None) -> None:
    """Train, write the weights, and print the errors on held-out objects.

    Raises:
        PgdmError: the hand or an object is unknown, or there is too little to learn from.
    """
    began = time.monotonic()
    known = sorted(open_library().objects())
    for name in leave_out:  # before anything takes time
        check_name("object to leave out", name, known)
    with bars() as progress:
        found = _collect(hand, progress)
        examples = [one for _, one in found]
        objects = sorted({one.object for one in examples})
        for name in leave_out:
            check_name("object to leave out", name, objects)
        kept = [one for one in examples if one.object not in leave_out]
        frame = GraspFrame(found[0][0])
        predictor = fit(kept, frame, leave_out, progress)
    path = out or weights.path_of(hand)
    weights.write(path, predictor)
    for line in _describe(predictor, len(kept)):
        print(line)
    print(f"weights: {path} ({duration(time.monotonic() - began)})")


def _describe(predictor: Predictor, poses: int) -> list[str]:
    """Return sentences about the data and the errors of a new predictor."""
    objects = len(predictor.objects)
    lines = [
        f"hand {predictor.hand}: {poses} pre-grasps of {objects} objects"
        + (f", without {', '.join(predictor.left_out)}" if predictor.left_out else ""),
        "with each object held out in turn, predicted fingertips are "
        f"{1e3 * predictor.error_m:.1f} mm off on average; those of the mean hand, "
        f"{1e3 * predictor.mean_hand_error_m:.1f} mm",
    ]
    if objects < _FEW_OBJECTS:
        lines.append(
            f"very few objects ({objects}): expect little more than a mean hand. Pre-grasps that "
            "you label or retarget for this hand are added to the data"
        )
    return lines


def _collect(hand: str, progress: StepProgress) -> list[tuple[Scene, Example]]:
    """Return a hand's mined pre-grasps and the user's, if usable, each with its scene.

    Raises:
        LibraryError: there is none.
    """
    library, tasks = open_library(), available("task")
    if library.is_filled:
        library = ensure(animated.TASKS[0], True, notify)  # compiles pgdm's own motions
    found: list[tuple[Scene, Example]] = []
    for task in counted("scenes", tasks, progress):
        cfg = compose([f"task={task}"])
        if cfg.task.motion not in library.tasks():
            continue
        is_task_hand = cfg.hand.name == hand
        if not is_task_hand:
            if not pregrasp_file.own(task, hand):
                continue
            cfg = compose([f"task={task}", f"hand={hand}"])
        poses = list(_poses(library, cfg, is_task_hand))
        if not poses:
            continue
        scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
        if not scene.lies_free:
            notify(f"{task}: left out, since its object lacks some of the six degrees of freedom")
            continue
        shown = [start.qpos for start in poses if not is_reset_pose(scene, start.qpos)]
        found += [(scene, one) for qpos in shown if (one := example(scene, qpos)) is not None]
    if not found:
        fill = "" if library.is_own_hand(hand) else f" (a filled library has some). {CURE}"
        raise LibraryError(
            f"there is no pre-grasp of hand '{hand}' to learn from. Make some with 'pgdm pregrasp "
            f"label' or 'pgdm pregrasp mocap'{fill}"
        )
    return found


def _poses(library: Library, cfg: ExperimentCfg, is_task_hand: bool) -> Iterator[Start]:
    starts = library.motion(cfg.task.motion).starts
    if is_task_hand and "mined" in starts:
        yield starts["mined"]
    for source in _OWN:
        own = pregrasp_file.find(cfg.task.id, cfg.hand.name, source)
        if own is not None:
            yield own.pose
