"""Options shared by several commands; values are checked before torch and MuJoCo are loaded."""

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
    """Return a callback that rejects a name that is not in ``names()``."""

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
    """Reject words that are neither tasks, suites, patterns nor existing ``.npz`` files."""
    expand_tasks(word for word in words if not word.endswith(".npz"))
    for word in words:
        if word.endswith(".npz"):
            existing(Path(word))
    return words


def known_sources(names: list[str] | None) -> list[str] | None:
    """Reject unknown pre-grasp sources."""
    for name in names or ():
        _known_source(name)
    return names


def existing(path: Path | None) -> Path | None:
    """Reject the path of an input file or folder that does not exist."""
    if path is not None and not path.exists():
        raise ConfigError(f"there is no file or folder '{path}'; check the path")
    return path


def known_run(path: Path) -> Path:
    """Return the path of a run or checkpoint, also if given as `pgdm runs` prints it."""
    folder_of(path)
    return located(path)


def known_runs(paths: list[Path]) -> list[Path]:
    """Return the paths of runs or checkpoints, as `known_run` does."""
    return [known_run(path) for path in paths]


EXPORTS = ("torchscript", "onnx", "safetensors", "minari")
POLICY_FILES = (".safetensors", ".xz", ".zip")
"""Suffixes of files that hold a policy, other than the checkpoints of runs."""


def known_policy(text: str) -> str:
    """Reject a text that names neither a run, a checkpoint, a policy file nor a zoo entry."""
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
                f"--{param.name} '{path}' is not {kind}; give a name that ends in {suffix}"
            )
        return path

    return check


def _known_port(port: int) -> int:
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port {port} is no port: give 1 to 65535, or 0 for any free one")
    return port


def complete_task(incomplete: str) -> list[str]:
    """Return the tasks that begin with the typed text, for shell completion."""
    return [name for name in available("task") if name.startswith(incomplete)]


def complete_tasks(incomplete: str) -> list[str]:
    """Return the tasks and suites that begin with the typed text, for shell completion."""
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
        help="Tasks, suites such as tcdm50, or patterns such as 'dhand-*'.",
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
        help="Start state of the hand, as pregrasp= of pgdm-run [planned].",
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
        help="Write an MP4 to this file; without it, pgdm view opens a window.",
        callback=_ending(".mp4", "an MP4"),
    ),
]
check_image = _ending(".png", "a PNG")
Image = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also draw the result to this PNG.", callback=check_image),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", callback=known_run)]
Policy = Annotated[
    str,
    typer.Argument(
        metavar="POLICY",
        help="Folder of a run, one of its checkpoints, zoo:NAME (see pgdm zoo list), .safetensors "
        "or .safetensors.xz file, or .zip file from Stable-Baselines3's PPO.",
        callback=known_policy,
    ),
]
Best = Annotated[
    bool,
    typer.Option(
        "--best",
        help="Only a run's folder: use the checkpoint of highest success, if any, not the last.",
    ),
]
ZipTask = Annotated[
    str | None,
    typer.Option(
        "--task", help="Only .zip: task the policy was trained on.", callback=_task_or_none
    ),
]
ZipSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Only .zip: pgdm-run setting of the policy's training that differs from the paper's; "
        "can be repeated.",
    ),
]
ZipStatistics = Annotated[
    Path | None,
    typer.Option(
        "--vecnormalize",
        metavar="FILE",
        help="Only .zip: file of VecNormalize.save with the policy's observation statistics.",
        callback=existing,
    ),
]
Offline = Annotated[
    bool, typer.Option("--offline", help="Never download assets; use earlier downloads.")
]
Port = Annotated[
    int,
    typer.Option(help="Port; 0, or one that is taken: a free port is used.", callback=_known_port),
]
Runs = Annotated[Path | None, typer.Argument(metavar="DIR", help="Folder of runs [runs].")]
