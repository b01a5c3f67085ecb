"""The typed configuration in a run folder: written atomically, checked when it is read."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pgdm.config.foreign import check_method
from pgdm.config.identity import check_continues, with_added_keys
from pgdm.config.schema import ExperimentCfg
from pgdm.config.strict import build
from pgdm.errors import ConfigError, RunError
from pgdm.runs.config_file import FORMAT, read_config, write_config
from pgdm.runs.files import CONFIG
from pgdm.runs.folder import holds_run


def save_config(cfg: ExperimentCfg, run_dir: str | os.PathLike[str]) -> Path:
    """Write the configuration into a run folder, atomically; return the file.

    Raises:
        OSError: if the folder cannot be written.
    """
    return write_config(Path(run_dir), dataclasses.asdict(cfg))


def load_config(run_dir: str | os.PathLike[str]) -> ExperimentCfg:
    """Read the configuration of a run folder.

    Its ``run_dir`` is the folder it was read from, even if the run has been moved. Keys that are
    newer than the run get the values that correspond to what the run did.

    Raises:
        RunError: if the folder holds no run.
        ConfigError: if the file is damaged, was edited wrongly, was written by a newer pgdm, or
            names a method of a module that is not trusted.
    """
    file = Path(run_dir) / CONFIG
    if not file.is_file():
        raise RunError(f"'{run_dir}' holds no run: it has no {CONFIG}; pgdm runs lists the runs")
    cure = "restore the file, or start a new run in another run_dir"
    try:
        plain = {str(key): value for key, value in read_config(file.parent).items()}
    except RunError as error:
        raise ConfigError(f"{error}; {cure}") from error
    try:
        return typed(plain, str(file), str(run_dir))
    except ConfigError as error:
        raise ConfigError(f"{error}; {cure}") from error


def typed(plain: Mapping[str, Any], where: str, run_dir: str) -> ExperimentCfg:
    """Return stored settings as the typed configuration.

    Args:
        plain: plain containers with the key ``format``, as `write_config` stores them.
        where: where they come from, for the messages.
        run_dir: folder of the run.

    Raises:
        ConfigError: if they are damaged, were edited wrongly, were written by a newer pgdm, or name
            a method of a module that is not trusted.
    """
    plain = dict(plain)
    version = plain.pop("format", None)
    if not isinstance(version, int) or version < 1:
        raise ConfigError(f"{where} has no valid format number (found {version!r})")
    if version > FORMAT:
        raise ConfigError(
            f"{where} has format {version}, this pgdm reads up to {FORMAT}; install a newer pgdm"
        )
    try:
        check_method(plain, where)
        cfg = build(ExperimentCfg, with_added_keys(plain) | {"run_dir": run_dir})
        cfg.validate()
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    return cfg


def check_run_dir(cfg: ExperimentCfg) -> None:
    """Check that a run may use its folder: it is new, or holds the same experiment.

    Raises:
        RunError: if the folder holds something else, or ``resume`` forbids using it.
    """
    if holds_run(Path(cfg.run_dir), cfg.resume):
        old = load_config(cfg.run_dir)
        check_continues(dataclasses.replace(old, run_dir=cfg.run_dir), cfg)
