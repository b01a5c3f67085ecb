"""Open a task's settings, scene or environment for a command."""

from __future__ import annotations

from typing import NamedTuple

from pgdm.cli.console.screen import bars, notify
from pgdm.config.compose import compose
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import assets, env_builder
from pgdm.library import Library, Motion, ensure
from pgdm.library.progress import StepProgress
from pgdm.sim.scene import Scene, build_scene


class Opened(NamedTuple):
    """A task's scene, and what it was compiled from."""

    cfg: ExperimentCfg
    library: Library
    motion: Motion
    scene: Scene


def composed(task: str, hand: str | None, *overrides: str, offline: bool = False) -> ExperimentCfg:
    """Return the settings of a task, with another hand if one is given."""
    chosen = [f"hand={hand}"] if hand else []
    return compose([f"task={task}", *chosen, *overrides, f"offline={str(offline).lower()}"])


def open_scene(cfg: ExperimentCfg, progress: StepProgress | None = None) -> Opened:
    """Compile the scene of a task, after fetching its assets if they are missing.

    Raises:
        PgdmError: if the assets cannot be fetched or the scene does not compile.
    """
    library = ensure(cfg.task.motion, cfg.offline, notify, progress=progress)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    return Opened(cfg, library, library.motion(cfg.task.motion), scene)


def open_env(cfg: ExperimentCfg) -> EnvBuilder:
    """Compile the environment of an experiment, and print what deviates from its settings.

    Raises:
        PgdmError: if an asset, the start or the wrist plan is missing and cannot be made.
    """
    with bars() as progress:
        library = assets(cfg, notify, progress)
        progress("compiling the scene", 0, 1)
        builder = env_builder(cfg, library, notify, progress)
    for note in builder.notes:
        notify(note)
    return builder
