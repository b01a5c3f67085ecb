"""What Hydra makes of a command line: the settings of one run, or of every job of a sweep."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgdm.cli.flags import DRY_RUN, Flags
from pgdm.errors import ConfigError, UnknownNameError

if TYPE_CHECKING:
    from omegaconf import DictConfig

# What only a sweep reads.
_OF_SWEEPS = ("sweep.", "hydra.launcher.", "hydra/launcher=", "hydra.sweeper.")


@dataclass
class Composed:
    """What a command line asks to be run."""

    jobs: list[tuple[tuple[str, ...], DictConfig]] = field(default_factory=list)
    """Overrides and settings of each; none if Hydra only printed something."""
    is_sweep: bool = False
    launcher_choice: str = ""
    """Which one starts the jobs of a sweep."""
    launcher: Any = None
    """Its settings, as plain data."""


def compose_all(flags: Flags) -> Composed:
    """Let Hydra make the settings of each run; nothing is started.

    Raises:
        ConfigError: if a key, an option or a value is wrong.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    from pgdm.config.groups import check_own
    from pgdm.config.store import COMPOSITION_ERRORS, check_overrides, conf_dir, explain

    if flags.config_dir is not None and not Path(flags.config_dir).is_dir():
        raise ConfigError(f"--config-dir '{flags.config_dir}' is not a folder")
    check_overrides(flags.overrides)
    check_own(flags.config_dir)
    for override in flags.overrides:
        key, _, value = override.partition("=")
        if key == "hydra/sweeper" and value != "pgdm":
            raise UnknownNameError("hydra/sweeper of pgdm", value, ["pgdm"])
    found = Composed()

    def collect(composed: DictConfig) -> None:
        # Runs start only after Hydra is done: all settings are then known to be right, and its
        # handling of errors and signals is out of the way.
        own = HydraConfig.get()
        found.jobs.append((tuple(own.overrides.task), composed))
        if len(found.jobs) == 1:
            found.is_sweep = own.mode == RunMode.MULTIRUN
            found.launcher = OmegaConf.to_container(own.launcher)
            found.launcher_choice = str(own.runtime.choices["hydra/launcher"])

    app = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(collect)
    with _hydra_command_line(flags):
        try:
            app()
        except COMPOSITION_ERRORS as error:
            raise explain(error, flags.overrides, flags.config_dir) from error
    stray = [override for override in flags.overrides if override.startswith(_OF_SWEEPS)]
    if "--dry-run" in flags.ours:  # of one run, it shows the run's terms
        stray.remove(DRY_RUN)
    if stray and found.jobs and not found.is_sweep:
        raise ConfigError(f"'{stray[0]}' is for sweeps; add -m, or leave it out")
    return found


@contextmanager
def _hydra_command_line(flags: Flags) -> Iterator[None]:
    """Show Hydra a command line of its own, and have it raise errors instead of printing them."""
    from pgdm.config.groups import own_folders
    from pgdm.config.store import search_path

    overrides = flags.overrides
    if flags.multirun:
        from pgdm.sweep.expand import with_tasks_as_choices

        overrides = with_tasks_as_choices(overrides)
    if not any(override.startswith("hydra.searchpath=") for override in overrides):
        overrides = [*search_path(own_folders(None)), *overrides]
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
