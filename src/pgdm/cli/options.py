"""Options that several commands have, checked before torch and the simulator load."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from pgdm.config.groups import available
from pgdm.config.suites import check_task, expand_tasks, suites
from pgdm.errors import ConfigError, check_name
from pgdm.library.files.pregrasp import SOURCES
from pgdm.runs.folder import folder_of, located
from pgdm.zoo import Zoo
from pgdm.zoo.place import PREFIX

Check = Callable[[str | None], str | None]


def one_of(kind: str, names: Callable[[], Iterable[str]]) -> Check:
    """Return a callback that refuses every name but some."""

    def check(name: str | None) -> str | None:
        if name is not None:
            check_name(kind, name, tuple(names()))
        return name

    return check


def _option(group: str) -> Check:
    return one_of(group, lambda: available(group))


_known_source = one_of("--source", lambda: ("mined", *SOURCES))


def _known_task(name: str) -> str:
    check_task(name)
    return name


def _task_or_none(name: str | None) -> str | None:
    return None if name is None else _known_task(name)


def tasks_or_files(words: list[str]) -> list[str]:
    """Refuse words that are neither tasks, suites or patterns nor ``.npz`` files."""
    expand_tasks(word for word in words if not word.endswith(".npz"))
    for word in words:
        if word.endswith(".npz"):
            existing(Path(word))
    return words


def known_sources(names: list[str] | None) -> list[str] | None:
    """Refuse the sources of pre-grasps that do not exist."""
    for name in names or ():
        _known_source(name)
    return names


def existing(path: Path | None) -> Path | None:
    """Refuse the path of an input that does not exist."""
    if path is not None and not path.exists():
        raise ConfigError(f"there is no file '{path}'; check the path")
    return path


def known_run(path: Path) -> Path:
    """Refuse a path that is neither a run nor a checkpoint; a run may be named as in a list."""
    folder_of(path)
    return located(path)


def known_runs(paths: list[Path]) -> list[Path]:
    """Refuse paths of which one is no run."""
    return [known_run(path) for path in paths]


EXPORTS = ("torchscript", "onnx", "safetensors", "minari")
POLICY_FILES = (".safetensors", ".xz", ".zip")
"""Endings of files that hold a policy, besides the checkpoints of runs."""


def known_policy(text: str) -> str:
    """Refuse what is neither a run, a checkpoint, a file with a policy, nor in the zoo."""
    if text.startswith(PREFIX):
        Zoo().entry(text.removeprefix(PREFIX))
    elif Path(text).suffix.lower() in POLICY_FILES:
        existing(Path(text))
    else:
        folder_of(Path(text))
    return text


def _ending(suffix: str, kind: str) -> Callable[[typer.CallbackParam, Path | None], Path | None]:
    def check(param: typer.CallbackParam, path: Path | None) -> Path | None:
        if path is not None and path.suffix.lower() != suffix:
            raise ConfigError(
                f"--{param.name} '{path}' is no {kind}; give a name that ends in {suffix}"
            )
        return path

    return check


def complete_task(incomplete: str) -> list[str]:
    """Return the tasks that begin with what was typed, for the shell."""
    return [name for name in available("task") if name.startswith(incomplete)]


def complete_tasks(incomplete: str) -> list[str]:
    """Return the tasks and suites that begin with what was typed, for the shell."""
    names = (*available("task"), *suites())
    return [name for name in names if name.startswith(incomplete)]


def _completing(group: str) -> Callable[[], list[str]]:
    return lambda: available(group)


TASK_HELP = "A task id, for example hammer-use1; pgdm tasks lists them."
Task = Annotated[
    str,
    typer.Argument(
        metavar="TASK", help=TASK_HELP, callback=_known_task, autocompletion=complete_task
    ),
]
Tasks = Annotated[
    list[str],
    typer.Argument(
        metavar="TASK...",
        help="Tasks, or suites such as tcdm50.",
        callback=tasks_or_files,
        autocompletion=complete_tasks,
    ),
]
check_hand = _option("hand")
Hand = Annotated[
    str | None,
    typer.Option(
        help="Use this hand instead of the task's: adroit, dhand, dmanus, or your own.",
        callback=check_hand,
        autocompletion=_completing("hand"),
    ),
]
Start = Annotated[
    str | None,
    typer.Option(
        help="Start of the hand, as in pgdm-run [planned].",
        callback=_option("pregrasp"),
        autocompletion=_completing("pregrasp"),
    ),
]
Source = Annotated[
    str,
    typer.Option(
        help="Pre-grasp to reach: mined, mocap, teleop, labeled or learned.",
        callback=one_of("--source", lambda: ("mined", *(s for s in SOURCES if s != "planned"))),
    ),
]
Video = Annotated[
    Path | None,
    typer.Option(
        help="Write an MP4 to this file instead of opening a window.",
        callback=_ending(".mp4", "MP4"),
    ),
]
check_image = _ending(".png", "PNG")
Image = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also draw it into this PNG.", callback=check_image),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", callback=known_run)]
Policy = Annotated[
    str,
    typer.Argument(
        metavar="POLICY",
        help="Folder of a run, one of its checkpoints, zoo:NAME (pgdm zoo list), a .safetensors of "
        "pgdm export, or a .zip of Stable-Baselines3's PPO.",
        callback=known_policy,
    ),
]
Best = Annotated[
    bool, typer.Option("--best", help="Use the checkpoint of highest success, not the last.")
]
ZipTask = Annotated[
    str | None,
    typer.Option("--task", help="Task of a .zip, which does not name it.", callback=_task_or_none),
]
ZipSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Setting of pgdm-run with which a .zip was trained [the paper's].",
    ),
]
ZipStatistics = Annotated[
    Path | None,
    typer.Option(
        "--vecnormalize",
        metavar="FILE",
        help="File of VecNormalize that belongs to a .zip.",
        callback=existing,
    ),
]
Offline = Annotated[bool, typer.Option("--offline", help="Never use the network.")]
Runs = Annotated[Path | None, typer.Argument(metavar="DIR", help="Folder of runs [runs].")]
