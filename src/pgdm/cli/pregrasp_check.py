"""``pgdm pregrasp check``: how good pre-grasps are, stored ones or one in a file."""

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
from pgdm.cli.pregrasp_scenes import Tell, composed, console, each, open_scene
from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import Motion, pregrasp_file
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.pregrasp import plans
from pgdm.pregrasp.quality import LiftTest, Quality, quality
from pgdm.pregrasp.reach import measure, plan_reach
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene

_HEADS = ("task", "hand", "source", "free", "deep mm", "fingertips mm", "palm deg", "lift", "reach")
_NUMBERS = 4, 5, 6, 7  # columns of numbers
SOURCES = ("mined", *pregrasp_file.SOURCES)


@dataclass(frozen=True)
class CheckRequest:
    """What is asked for."""

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
    """Actions (K, nu) of the plan that is stored, if any."""
    target: np.ndarray
    """What the plan leads to (nq,)."""


def check_pregrasps(request: CheckRequest) -> None:
    """Measure, print, and write the figures.

    Raises:
        PgdmError: if a name is unknown, a file is damaged, or a task has no such pre-grasp.
    """
    for source in request.sources:
        if source not in SOURCES:
            raise UnknownNameError("--source", source, SOURCES)
    files = {word: Path(word) for word in request.words if word.endswith(".npz")}
    if files and request.sources:
        raise ConfigError("--source chooses among a task's pre-grasps; a FILE is one by itself")
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
            for name, tell in rest:
                for row in _rows(name, files.get(name), request, tell):
                    rows.append(row)
                    table.add_row(*_cells(row))
    finally:  # also after Ctrl-C
        if rows:
            console().print(table)
        if rows and request.json_file is not None:
            request.json_file.parent.mkdir(parents=True, exist_ok=True)
            with paths.replacing(request.json_file) as temp:
                temp.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            print(f"figures: {request.json_file}")


def _rows(
    name: str, file: Path | None, request: CheckRequest, tell: Tell
) -> Iterator[dict[str, Any]]:
    if file is None:
        task, hand, stored = name, request.hand, None
    else:
        stored = pregrasp_file.read(file)
        task, hand = _whose(file, stored, request.hand)
    scene, motion = open_scene(task, hand, request.offline)
    found = _stored(scene, motion, request.sources) if stored is None else [_own(stored, file)]
    lift = LiftTest(scene, motion.substeps, request.policies, request.seed)
    for i, one in enumerate(found):
        _check_fits(one, scene)
        tell(i / len(found), one.source)
        measured = quality(scene, one.qpos, motion.substeps, lift)
        plan = None
        if one.plan is not None:
            plan = measure(scene, one.plan, one.target, motion.substeps)
        elif request.reach:
            plan = plan_reach(scene, one.target, motion.substeps, seed=request.seed)
        yield _row(scene, one, measured, plan)


def _stored(scene: Scene, motion: Motion, sources: Sequence[str]) -> list[_Checked]:
    """Return a task's pre-grasps for this hand, the user's own before those of the library.

    Raises:
        ConfigError: if there is none of what was asked for.
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
    if "mined" in found and "planned" in found:  # a plan of the user's own goes before another's
        found["mined"] = dataclasses.replace(found["mined"], plan=found["planned"].plan)
    missing = [source for source in sources if source not in found]
    if missing or not found:
        raise ConfigError(
            f"task '{task}' has no pre-grasp {' or '.join(missing)} for hand '{hand}'; it has: "
            f"{', '.join(found) or 'none'}. 'pgdm pregrasp --help' lists how to make one"
        )
    return [found[name] for name in (sources or found)]


def _own(own: Pregrasp, path: Path | None) -> _Checked:
    """Return a pre-grasp of the user's own: of a plan where it ends, else the pose."""
    source = path.stem if path is not None else ""
    start = own.start if source == "planned" else own.pose
    plan = None if own.reached is None else own.reached.actions
    return _Checked(source, start.qpos, plan, own.pose.qpos)


def _whose(file: Path, own: Pregrasp, hand: str | None) -> tuple[str, str]:
    """Return task and hand of a file: its note or its folders tell.

    Raises:
        ConfigError: if nothing tells.
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
    figures = dataclasses.asdict(measured)
    figures["lift_rate"] = None if math.isnan(measured.lift_rate) else measured.lift_rate
    row = {"task": scene.task.id, "hand": scene.hand.name, "source": one.source, **figures}
    row |= {"plan_stored": one.plan is not None, "reachable": None, "why": []}
    if plan is None:
        return row
    return row | {"reachable": plan.reached, "why": plan.failures, "reach": plans.figures(plan)}


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
