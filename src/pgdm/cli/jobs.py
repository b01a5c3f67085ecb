"""The runs that a command line asks for: one experiment, or all jobs of a sweep."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgdm.cli.flags import DRY_RUN, Flags
from pgdm.errors import ConfigError, UnknownNameError, check_at_least
from pgdm.runs.folder import holds_run

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from pgdm.config.compose import Composer
    from pgdm.library.progress import StepProgress
    from pgdm.sweep.expand import Composed

# Prefixes of overrides that only sweeps read.
_OF_SWEEPS = ("sweep.", "hydra.launcher.", "hydra/launcher=", "hydra.sweeper.")


@dataclass
class Asked:
    """The runs that a command line asks for."""

    jobs: list[Composed] = field(default_factory=list)
    """Overrides and settings of each run; empty if Hydra only printed something."""
    is_sweep: bool = False
    launcher_choice: str = ""
    """Name of the launcher that starts the jobs of a sweep."""
    launcher: Any = None
    """The launcher's settings, as plain dicts and lists."""


def read_jobs(flags: Flags, progress: StepProgress) -> Asked:
    """Compose the settings of each run, or let Hydra print what its flags ask for; start nothing.

    Args:
        flags: the command line.
        progress: called with the number of jobs composed so far.

    Raises:
        ConfigError: if a key, an option or a value is wrong.
        RunError: if a run folder cannot be used.
    """
    from pgdm.config.compose import Composer

    if flags.config_dir is not None and not Path(flags.config_dir).is_dir():
        raise ConfigError(f"--config-dir '{flags.config_dir}' is not a folder")
    composer = Composer(flags.config_dir, flags.overrides)
    for override in flags.overrides:
        key, _, value = override.partition("=")
        if key == "hydra/sweeper" and value != "pgdm":
            raise UnknownNameError("hydra/sweeper of pgdm", value, ["pgdm"])
    if flags.prints:
        if "--shell-completion" not in flags.hydras:  # its arguments are not overrides
            composer.whole(flags.overrides, flags.multirun)
        _print(composer, flags)
        return Asked()
    asked = _sweep(composer, flags, progress) if flags.multirun else _single(composer, flags)
    for overrides, settings in asked.jobs:
        composer.check(overrides, settings)
    return asked


def _single(composer: Composer, flags: Flags) -> Asked:
    _offer(composer.whole(flags.overrides, typed=flags.typed))
    settings = composer.plain(flags.overrides)
    stray = [override for override in flags.overrides if override.startswith(_OF_SWEEPS)]
    if "--dry-run" in flags.ours:  # allowed for a single run: it shows the run's terms
        stray.remove(DRY_RUN)
    if stray:
        raise ConfigError(f"'{stray[0]}' is for sweeps; add -m, or leave it out")
    if (chosen := settings.get("run_dir")) is not None:
        holds_run(Path(str(chosen)), str(settings.get("resume")))
    return Asked([(tuple(flags.overrides), settings)])


def _sweep(composer: Composer, flags: Flags, progress: StepProgress) -> Asked:
    from omegaconf import OmegaConf

    from pgdm.sweep.expand import composed_jobs, with_tasks_as_choices

    overrides = with_tasks_as_choices(flags.overrides)
    whole = composer.whole(overrides, multirun=True, typed=flags.typed)
    _offer(whole)
    most = whole.sweep.get("most_jobs")
    check_at_least("sweep.most_jobs", most if isinstance(most, int) else 0, 1)
    # hydra.sweeper.params holds the sweep values of settings files; overrides come after them
    # and take precedence.
    written = [f"{key}={value}" for key, value in whole.hydra.sweeper.params.items()]
    own = [str(o.input_line) for o in composer.parse(overrides) if not o.is_hydra_override()]
    folder = None if flags.config_dir is None else Path(flags.config_dir)
    return Asked(
        composed_jobs(composer, [*written, *own], folder, progress, most),
        is_sweep=True,
        launcher_choice=str(whole.hydra.runtime.choices["hydra/launcher"]),
        launcher=OmegaConf.to_container(whole.hydra.launcher),
    )


def _offer(whole: DictConfig) -> None:
    """Let settings refer to Hydra's settings, as in ``run_dir=${hydra:runtime.cwd}/out``."""
    from hydra.core.hydra_config import HydraConfig

    HydraConfig.instance().set_config(whole)


def _print(composer: Composer, flags: Flags) -> None:
    """Start an empty Hydra application, which prints what Hydra's flags ask for and exits."""
    import hydra

    from pgdm.config.groups import conf_dir

    def nothing(settings: DictConfig) -> None:
        del settings

    app = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(nothing)
    with composer.explaining(flags.overrides), _hydra_command_line(flags):
        app()


@contextmanager
def _hydra_command_line(flags: Flags) -> Iterator[None]:
    """Set ``sys.argv`` to what Hydra should read, and let it raise errors instead of printing."""
    from pgdm.config.groups import own_folders

    overrides = flags.overrides
    lasting = [
        str(folder).replace("\\", "\\\\").replace("'", "\\'") for folder in own_folders(None)
    ]
    if lasting and not any(override.startswith("hydra.searchpath=") for override in overrides):
        overrides = [f"hydra.searchpath=['file://{lasting[0]}']", *overrides]
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = ["pgdm-run", *flags.hydras, *overrides]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv = argv
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error
