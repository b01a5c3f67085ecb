"""``pgdm doctor``: check what pgdm needs on this machine, and say how to fix what is missing."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from pgdm import paths
from pgdm.cli.console.screen import bars, tables
from pgdm.errors import PgdmError, amount
from pgdm.library import open_library
from pgdm.library.catalog import CURE
from pgdm.memory import free_bytes
from pgdm.runs.provenance import versions
from pgdm.tracking.address import VARIABLE, chosen

ENOUGH_GB = 2
"""Free memory that a run needs with the default settings, GB."""


class Check(NamedTuple):
    """One line of the table."""

    subject: str
    sound: bool | None
    """Whether it works; None: it does not, but is optional."""
    found: str
    """What was found, or what to do."""


def diagnose() -> int:
    """Print the table; return 1 if anything does not work that the default settings require."""
    table = Table(box=None, header_style="bold")
    for name in ("subject", "", "what was found, or what to do"):
        table.add_column(name, overflow="fold")
    sound = True
    with bars(patience_s=2.0) as progress:
        for number, (subject, check) in enumerate(CHECKS.items()):
            progress(subject, number, len(CHECKS))
            for line in check():
                sound &= line.sound is not False
                mark = {True: "ok", False: "PROBLEM", None: "-"}[line.sound]
                table.add_row(line.subject, mark, Text(line.found))
    tables().print(table)
    return 0 if sound else 1


def _versions() -> Iterator[Check]:
    found = versions()
    missing = [name for name, version in found.items() if version == "not installed"]
    listed = ", ".join(f"{name} {version}" for name, version in found.items())
    cure = f"install {', '.join(missing)}: pip install -c constraints.txt -e ." if missing else ""
    yield Check("versions", not missing, cure or listed)


def _rendering() -> Iterator[Check]:
    from pgdm.sim import gl

    try:
        gl.backends()  # raises an error if rendering is switched off
        backend = gl.context_class().__module__.rpartition(".")[2]
    except PgdmError as error:  # optional: runs work without videos
        yield Check("rendering", None, str(error))
    else:
        yield Check("rendering", True, f"{backend}: videos are rendered without a display")


def _machine() -> Iterator[Check]:
    import torch

    from pgdm.rl.sac import has_bfloat16

    bfloat16 = "with" if has_bfloat16("cpu") else "without"
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count()
    yield Check("processor", True, f"{amount(cores or 1, 'core')}, {bfloat16} bfloat16")
    free = free_bytes() / 1e9
    cure = f"only {free:.1f} GB are free, a run needs about {ENOUGH_GB}: close other programs"
    enough = free >= ENOUGH_GB
    yield Check("memory", enough, f"{free:.1f} GB are free" if enough else cure)
    disk = paths.free_bytes(paths.library()) / 1e9
    yield Check("disk", disk > 1, f"{disk:.1f} GB are free in {paths.library()} (needed: over 1)")
    if torch.cuda.is_available():
        yield Check("GPU", True, f"{torch.cuda.get_device_name()}: used with device=cuda")
    else:
        yield Check("GPU", None, "torch finds none; device=cpu needs none")
    try:
        importlib.import_module("pgdm.sim.warp")
    except PgdmError as error:
        yield Check("MuJoCo Warp", None, str(error))
    else:
        yield Check("MuJoCo Warp", True, "used with sim=warp")


def _library() -> Iterator[Check]:
    try:
        library = open_library()
    except PgdmError as error:
        yield Check("library", False, str(error))
        return
    counts = ", ".join(f"{s} {amount(len(m.tasks), 'task')}" for s, m in library.sources().items())
    where = f"{counts or f'empty; runs fetch what they need. {CURE}'} ({library.root})"
    yield Check("library", True, where)


def _store() -> Iterator[Check]:
    import importlib.util

    notes: list[str] = []
    try:
        store = chosen(None, "tracking.uri", notes.append) or "mlflow.db in the folder of runs"
    except PgdmError as error:
        yield Check("MLflow store", False, f"{error}; or unset {VARIABLE}")
        return
    there = importlib.util.find_spec("mlflow") is not None
    yield Check("MLflow store", there, store if there else "install mlflow, or use tracking=none")


def _slurm() -> Iterator[Check]:
    from pgdm.sweep.queue import output

    if shutil.which("sbatch") is None:
        yield Check("Slurm", None, "there is no sbatch; sweeps run on this machine")
        return
    try:
        nodes = output(["sinfo", "--noheader", "--format=%P %D %T"]).split("\n")
    except PgdmError as error:
        yield Check("Slurm", None, f"sinfo failed; sweeps run on this machine ({error})")
    else:
        yield Check(
            "Slurm", True, f"{'; '.join(filter(None, nodes))}: used with hydra/launcher=slurm"
        )


CHECKS: dict[str, Callable[[], Iterator[Check]]] = {
    "versions": _versions,
    "processor, memory, GPU": _machine,
    "rendering": _rendering,
    "library": _library,
    "MLflow store": _store,
    "Slurm": _slurm,
}
