"""``pgdm pregrasp show``: list the pre-grasps of a task."""

from __future__ import annotations

from rich.table import Table

from pgdm.cli.console.screen import console, notify
from pgdm.cli.scenes import composed
from pgdm.library import Start, ensure
from pgdm.library.files import pregrasp as pregrasp_file


def run(task: str, hand: str | None, offline: bool) -> None:
    """Print the pre-grasps that a task has for a hand: the library's and the user's own.

    Raises:
        PgdmError: the task or hand is unknown, or a file is damaged.
    """
    cfg = composed(task, hand)
    library = ensure(cfg.task.motion, offline, notify)
    name = cfg.hand.name
    table = Table("source", "from", "made by", "penetration", "plan", box=None)
    if library.entry(cfg.task.motion).hand == name:
        for source, start in library.motion(cfg.task.motion).starts.items():
            table.add_row(source, "library", "published", "-", _steps(start))
    for source in pregrasp_file.own(task, name):
        own = pregrasp_file.read(pregrasp_file.path_of(task, name, source))
        depth = own.note.get("depth_mm")
        made_by = str(own.note.get("made_by", "-"))
        penetration = "-" if depth is None else f"{depth} mm"
        table.add_row(source, "you", made_by, penetration, _steps(own.reached))
    if table.rows:
        console().print(table)
        return
    other = f" --hand {hand}" if hand else ""
    print(
        f"{task} has no pre-grasp for hand {name} yet; pgdm pregrasp mocap {task}{other} makes one"
    )


def _steps(start: Start | None) -> str:
    return "-" if start is None or start.actions is None else f"{len(start.actions)} steps"
