"""The configuration in a run folder: written whole, read back strictly."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import yaml

from pgdm.config.identity import check_continues, with_added_keys
from pgdm.config.schema import ExperimentCfg
from pgdm.config.strict import build
from pgdm.errors import ConfigError, RunError

FILE = "config.yaml"
FORMAT = 1

# What a run that ended before its first file was written may leave.
_LEFT_BEHIND = (".lock", "mlflow.json")

_HEADER = "# All settings of this run. pgdm-run compares them when the run goes on.\n"


def save_config(cfg: ExperimentCfg, run_dir: str | os.PathLike[str]) -> Path:
    """Write the configuration into a run folder, atomically, and return the file.

    Raises:
        OSError: if the folder cannot be written.
    """
    file = Path(run_dir) / FILE
    plain = {"format": FORMAT} | dataclasses.asdict(cfg)
    text = _HEADER + yaml.safe_dump(plain, sort_keys=False, width=100)
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{FILE}.{os.getpid()}.part")
    try:
        with part.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return file


def load_config(run_dir: str | os.PathLike[str]) -> ExperimentCfg:
    """Read the configuration of a run folder.

    Its ``run_dir`` is the folder it was read from, wherever that has been moved to. Keys that came
    after the run was made have the values that it was made with.

    Raises:
        RunError: if the folder holds no run.
        ConfigError: if the file is damaged, was edited wrongly, or is of a newer pgdm.
    """
    file = Path(run_dir) / FILE
    if not file.is_file():
        raise RunError(f"'{run_dir}' holds no run: it has no {FILE}; pgdm runs lists those here")
    plain = _read(file)
    cure = "restore the file, or start a new run in another run_dir"
    version = plain.pop("format", None)
    if not isinstance(version, int) or version < 1:
        raise ConfigError(f"{file} has no valid format number (found {version!r}); {cure}")
    if version > FORMAT:
        raise ConfigError(
            f"{file} has format {version}, this pgdm reads up to {FORMAT}; install a newer pgdm"
        )
    try:
        cfg = build(ExperimentCfg, with_added_keys(plain) | {"run_dir": str(run_dir)})
        cfg.validate()
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}; {cure}") from error
    return cfg


def check_run_dir(cfg: ExperimentCfg) -> None:
    """Check that a run may use its folder: it is new, or holds the same run.

    Raises:
        RunError: if it holds something else, or what ``resume`` does not allow.
    """
    run_dir = Path(cfg.run_dir)
    if run_dir.exists() and not run_dir.is_dir():
        raise RunError(f"run_dir '{run_dir}' is a file; choose a folder")
    if (run_dir / FILE).exists():
        if cfg.resume == "never":
            raise RunError(f"'{run_dir}' holds a run and resume=never; choose another run_dir")
        old = load_config(run_dir)
        check_continues(dataclasses.replace(old, run_dir=cfg.run_dir), cfg)
        return
    if cfg.resume == "must":
        raise RunError(f"'{run_dir}' holds no run and resume=must; check run_dir")
    if run_dir.is_dir() and any(p.name not in _LEFT_BEHIND for p in run_dir.iterdir()):
        raise RunError(f"'{run_dir}' is not empty and holds no run; choose another run_dir")


def _read(file: Path) -> dict[str, Any]:
    cure = "restore it, or start a new run in another run_dir"
    try:
        plain = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{file} is damaged ({reason}); {cure}") from error
    if not isinstance(plain, dict):
        raise ConfigError(f"{file} is damaged (it holds no keys); {cure}")
    return {str(key): value for key, value in plain.items()}
