"""``pgdm pregrasp check``: measure the quality of pre-grasps, stored or in a file."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from pgdm import paths
from pgdm.cli.console.screen import each, tables
from pgdm.cli.scenes import composed, open_scene
from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError
from pgdm.library import Motion
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.library.progress import StepProgress, counted
from pgdm.pregrasp.quality import LiftTest, Quality, quality
from pgdm.pregrasp.reach import stored as plans
from pgdm.pregrasp.reach.plan import ReachPlan, measure
from pgdm.pregrasp.reach.planner import plan_reach
from pgdm.sim.scene import Scene

_HEADS = (
    "task",
    "hand",
    "source",
    "free",
    "penetration mm",
    "fingertips mm",
    "palm deg",
    "lift",
    "reach",
)
_NUMBERS = 4, 5, 6, 7  # columns of numbers


@dataclass(frozen=True)
class Request:
    """What to check, and how."""

    words: Sequence[str]
    hand: str | None
    sources: Sequence[str]
    reach: bool
    policies: int
    seed: int
    json_file: Path | None
    offline: bool


@dataclass(frozen=True)
class _Checked:
    """One pre-grasp of a task."""

    source: str
    qpos: np.ndarray  # (nq,)
    plan: np.ndarray | None
    """Actions (K, nu) of the stored plan, if any."""
    target: np.ndarray
    """Pose that the plan leads to (nq,)."""


def run(request: Request) -> None:
    """Measure pre-grasps, and print and write the measurements.

    Raises:
        PgdmError: if a name is unknown, a file is damaged, or a task lacks a requested pre-grasp.
    """
    files = {word: Path(word) for word in request.words if word.endswith(".npz")}
    if files and request.sources:
        raise ConfigError("--source chooses among the pre-grasps of a task; a FILE holds only one")
    words = [
        w for word in request.words for w in ([word] if word in files else expand_tasks([word]))
    ]
    names = list(dict.fromkeys(words))
    table = Table(box=None, pad_edge=False)
    for i, head in enumerate(_HEADS):
        table.add_column(head, justify="right" if i in _NUMBERS else "left")
    rows: list[dict[str, Any]] = []
    try:
        with each(names) as rest:
            for name, progress in rest:
                for row in _rows(name, files.get(name), request, progress):
                    rows.append(row)
                    table.add_row(*_cells(row))
    finally:  # also after Ctrl-C
        if rows:
            tables().print(table)
        if rows and request.json_file is not None:
            request.json_file.parent.mkdir(parents=True, exist_ok=True)
            with paths.replacing(request.json_file) as temp:
                temp.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            print(f"measurements: {request.json_file}")


def _rows(
    name: str, file: Path | None, request: Request, progress: StepProgress
) -> Iterator[dict[str, Any]]:
    if file is None:
        task, hand, stored = name, request.hand, None
    else:
        stored = pregrasp_file.read(file)
        task, hand = _whose(file, stored, request.hand)
    _, _, motion, scene = open_scene(composed(task, hand, offline=request.offline), progress)
    found = _stored(scene, motion, request.sources) if stored is None else [_own(stored, file)]
    lift = LiftTest(scene, motion.substeps, request.policies, request.seed)
    for one in counted("pre-grasps", found, progress):
        _check_fits(one, scene)
        measured = quality(scene, one.qpos, motion.substeps, lift)
        plan = None
        if one.plan is not None:
            plan = measure(scene, one.plan, one.target, motion.substeps)
        elif request.reach:
            steps, seed = motion.substeps, request.seed
            plan = plan_reach(scene, one.target, steps, seed=seed, progress=progress)
        yield _row(scene, one, measured, plan)


def _stored(scene: Scene, motion: Motion, sources: Sequence[str]) -> list[_Checked]:
    """Return a task's pre-grasps for a hand, one for each source: the user's or else the library's.

    Raises:
        ConfigError: if one of the sources is missing, or there is no pre-grasp at all.
    """
    task, hand, nq = scene.task.id, scene.hand.name, scene.model.nq
    fitting = {n: start.qpos for n, start in motion.starts.items() if start.qpos.shape == (nq,)}
    published = plans.published(motion, scene)
    plan = None if published is None else published.actions
    mined = fitting.get("mined")
    found = {
        name: _Checked(name, qpos, plan, mined)
        if name in ("mined", "planned") and mined is not None
        else _Checked(name, qpos, None, qpos)
        for name, qpos in fitting.items()
    }
    for name in pregrasp_file.own(task, hand):
        own = pregrasp_file.find(task, hand, name)
        assert own is not None
        found[name] = _own(own, pregrasp_file.path_of(task, hand, name))
    if "mined" in found and "planned" in found:  # the user's own plan, if any
        found["mined"] = dataclasses.replace(found["mined"], plan=found["planned"].plan)
    missing = [source for source in sources if source not in found]
    if missing or not found:
        wanted = f"pre-grasp {' or '.join(missing)}".rstrip()
        raise ConfigError(
            f"task '{task}' has no {wanted} for hand '{hand}'; it has: "
            f"{', '.join(found) or 'none'}. 'pgdm pregrasp --help' shows how to make one"
        )
    return [found[name] for name in (sources or found)]


def _own(own: Pregrasp, path: Path | None) -> _Checked:
    """Return a pre-grasp of the user's: for ``planned`` the end of its plan, otherwise its pose."""
    source = path.stem if path is not None else ""
    start = own.start if source == "planned" else own.pose
    plan = None if own.reached is None else own.reached.actions
    return _Checked(source, start.qpos, plan, own.pose.qpos)


def _whose(file: Path, own: Pregrasp, hand: str | None) -> tuple[str, str]:
    """Return task and hand of a file, from its note or else from the names of its folders.

    A given ``hand`` takes precedence.

    Raises:
        ConfigError: if neither gives a valid task and hand.
    """
    folders = file.absolute().parent
    task = str(own.note.get("task", folders.parent.name))
    found = hand or str(own.note.get("hand", folders.name))
    try:
        composed(task, found)
    except ConfigError as error:
        raise ConfigError(
            f"{file}: which task and hand is it for? Its folders should be TASK/HAND, as in "
            f"{pregrasp_file.path_of('hammer-use1', 'adroit', 'labeled')}; {error}"
        ) from error
    return task, found


def _check_fits(one: _Checked, scene: Scene) -> None:
    if one.qpos.shape != (scene.model.nq,):
        raise ConfigError(
            f"the pre-grasp has {one.qpos.size} positions; the scene of task '{scene.task.id}' "
            f"with hand '{scene.hand.name}' has {scene.model.nq}"
        )


def _row(scene: Scene, one: _Checked, measured: Quality, plan: ReachPlan | None) -> dict[str, Any]:
    row: dict[str, Any] = {"task": scene.task.id, "hand": scene.hand.name, "source": one.source}
    row |= dataclasses.asdict(measured)
    row["lift_rate"] = None if math.isnan(measured.lift_rate) else measured.lift_rate
    row |= {"plan_stored": one.plan is not None, "reachable": None, "why": []}
    if plan is None:
        return row
    return row | {"reachable": plan.reached, "why": plan.failures, "reach": plan.metrics()}


def _cells(row: dict[str, Any]) -> list[str]:
    lift = row["lift_rate"]
    if row["reachable"] is None:
        reach = "not tried (--reach)"
    else:
        reach = "stored plan: " if row["plan_stored"] else ""
        reach += "yes" if row["reachable"] else f"no, {'; '.join(row['why'])}"
    return [
        *(row["task"], row["hand"], row["source"], "yes" if row["free"] else "no"),
        f"{1e3 * row['depth_m']:.1f}",
        f"{1e3 * row['fingertip_distance_m']:.0f}",
        f"{math.degrees(row['palm_angle_rad']):.0f}",
        "-" if lift is None else f"{lift:.0%}",
        reach,
    ]
