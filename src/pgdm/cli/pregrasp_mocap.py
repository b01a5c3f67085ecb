"""``pgdm pregrasp mocap``: a human hand's pre-grasp for any hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pgdm.cli.assets import bars
from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.config.hands import own_hand
from pgdm.config.schema import ExperimentCfg
from pgdm.experiment import threads
from pgdm.library import Library, Motion, Start, ensure, pregrasp_file
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.library.report import Progress
from pgdm.pregrasp import recording
from pgdm.pregrasp.mocap import Retargeted, check, retarget
from pgdm.pregrasp.provide import Wanted, human_hand, store, with_plan
from pgdm.sim.scene import Scene, build_scene


def mocap(
    task: str,
    hand: str | None,
    file: Path | None,
    frame: int | None,
    reach: bool,
    image: Path | None,
    offline: bool,
) -> None:
    """Make and store a pre-grasp from a human hand, and tell how it fits.

    Raises:
        PgdmError: the task, hand or file is unknown or damaged, or the hand cannot take it up.
    """
    cfg = composed(task, hand)
    library = ensure(cfg.task.motion, offline, notify)
    motion = library.motion(cfg.task.motion)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    wanted = Wanted(cfg.task, cfg.hand, own_hand(cfg, library), cfg.sim, "mocap")
    with bars() as progress:
        if file is None:
            human = human_hand(library, wanted, motion, offline, notify)
        else:
            human = recording.read(file)
        progress("inverse kinematics", 0, 1)
        made = retarget(scene, library, motion, human, frame)
        progress("inverse kinematics", 1, 1)
        check(made, scene)
        made = replace(made, pregrasp=planned(made.pregrasp, scene, motion, reach, cfg, progress))
    store(wanted.path, made.pregrasp)
    _say(made, scene)
    stored(wanted.path, image, made.pregrasp, scene)


def planned(
    pregrasp: Pregrasp,
    scene: Scene,
    motion: Motion,
    reach: bool,
    cfg: ExperimentCfg,
    progress: Progress,
) -> Pregrasp:
    """Return a pre-grasp with its reach plan, if one is wanted."""
    if not reach:
        return pregrasp
    return with_plan(pregrasp, scene, motion, notify, progress, threads(cfg))


def stored(path: Path, image: Path | None, pregrasp: Pregrasp, scene: Scene) -> None:
    """Tell where a pre-grasp lies, how it is used, and draw it if wanted."""
    reach = pregrasp.note.get("reach")
    if reach:
        print(
            f"reach plan: base off by {reach['base_error_mm']} mm and {reach['base_error_rad']} "
            f"rad, joints by {reach['finger_error_rad']} rad, object moved "
            f"{reach['object_moved_mm']} mm{'' if reach['plan_taken'] else '; not taken'}"
        )
    print(f"stored: {path}")
    hand, source = path.parent.name, path.stem
    print(f"to use it: pgdm-run task={scene.task.id} hand={hand} pregrasp={source}")
    if image is not None:
        from pgdm.sim.sheet import Panel, write_sheet

        title = f"{scene.task.id}  {scene.hand.name}"
        panels = [Panel(pregrasp.pose.qpos, title, f"{source}: the pose")]
        if pregrasp.reached is not None:
            panels.append(Panel(pregrasp.reached.qpos, title, f"{source}: after the reach plan"))
        print(f"image: {write_sheet(scene, panels, image)}")


def show(task: str, hand: str | None, offline: bool) -> None:
    """Print which pre-grasps a task has for a hand, stored and the user's own.

    Raises:
        PgdmError: the task or hand is unknown, or a file is damaged.
    """
    cfg = composed(task, hand)
    library: Library = ensure(cfg.task.motion, offline, notify)
    name = cfg.hand.name
    table = Table("source", "from", "made by", "penetration", "plan", box=None)
    if library.entry(cfg.task.motion).hand == name:
        for source, start in library.motion(cfg.task.motion).starts.items():
            plan = _steps(start)
            table.add_row(source, "library", "published", "-", plan)
    for source in pregrasp_file.own(task, name):
        own = pregrasp_file.read(pregrasp_file.path_of(task, name, source))
        plan = _steps(own.reached)
        depth = own.note.get("depth_mm")
        made_by = str(own.note.get("made_by", "-"))
        table.add_row(source, "you", made_by, "-" if depth is None else f"{depth} mm", plan)
    if table.rows:
        Console().print(table)
        return
    other = f" --hand {hand}" if hand else ""
    print(
        f"{task} has no pre-grasp of hand {name} yet; pgdm pregrasp mocap {task}{other} makes one"
    )


def _steps(start: Start | None) -> str:
    return "-" if start is None or start.actions is None else f"{len(start.actions)} steps"


def _say(made: Retargeted, scene: Scene) -> None:
    note = made.pregrasp.note
    print(f"{scene.task.id} with hand {scene.hand.name}, from {note['from']}, frame {made.frame}")
    table = Table("fingertip", "from its target", box=None)
    for i, finger in enumerate(made.fingers):
        error = f"{1e3 * made.result.fingertip_errors_m[i]:.1f} mm"
        table.add_row(finger, error if i in made.measured else "not measured")
    Console().print(table)
    print(
        f"palm {made.result.palm_error_rad:.2f} rad from the human's, penetration "
        f"{note['depth_mm']} mm, joints at a limit: {', '.join(made.result.at_limit) or 'none'}"
    )
    for line in made.unreachable:
        print(f"unreachable: {line}")
