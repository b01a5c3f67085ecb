"""``pgdm pregrasp mocap``: retarget a human hand to a pre-grasp of a robot hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.table import Table

from pgdm.cli.console.screen import bars, console, notify
from pgdm.cli.pregrasp.stored import planned, report_with_reach
from pgdm.cli.scenes import composed, open_scene
from pgdm.config.hands import own_hand
from pgdm.pregrasp.on_demand import Wanted, human_hand, store
from pgdm.pregrasp.retarget import recording
from pgdm.pregrasp.retarget.mocap import Retargeted, check, retarget
from pgdm.sim.scene import Scene


def run(
    task: str,
    hand: str | None,
    file: Path | None,
    frame: int | None,
    reach: bool,
    image: Path | None,
    offline: bool,
) -> None:
    """Make and store a pre-grasp from a human hand, and print how well it fits.

    Raises:
        PgdmError: the task, hand or file is unknown or damaged, or the hand cannot take the pose.
    """
    opened = open_scene(composed(task, hand, offline=offline))
    cfg, library, motion, scene = opened
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
        made = replace(made, pregrasp=planned(made.pregrasp, opened, reach, progress))
    store(wanted.path, made.pregrasp)
    _print_fit(made, scene)
    report_with_reach(wanted.path, image, made.pregrasp, scene)


def _print_fit(made: Retargeted, scene: Scene) -> None:
    note = made.pregrasp.note
    print(f"{scene.task.id} with hand {scene.hand.name}, from {note['from']}, frame {made.frame}")
    table = Table("fingertip", "distance from target", box=None)
    for i, finger in enumerate(made.fingers):
        error = f"{1e3 * made.result.fingertip_errors_m[i]:.1f} mm"
        table.add_row(finger, error if i in made.measured else "not measured")
    console().print(table)
    print(
        f"palm {made.result.palm_error_rad:.2f} rad from the human's, penetration "
        f"{note['depth_mm']} mm, joints at a limit: {', '.join(made.result.at_limit) or 'none'}"
    )
    for line in made.unreachable:
        print(f"unreachable: {line}")
