"""Refuse settings from other people that would make Hydra, Python or a shell run code."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pgdm import files, paths
from pgdm.errors import ConfigError

TRUSTED = "PGDM_METHODS"
"""Environment variable: modules with methods that may be imported, separated by commas."""

_REFUSED = {
    "hydra.callbacks": "it names code to run",
    "hydra.job_logging": "pgdm sets up its own logging",
    "hydra.hydra_logging": "pgdm sets up its own logging",
    "hydra.searchpath": "give the folder with --config-dir",
    "sweep.most_jobs": "type it after pgdm-run",
}
"""Keys that Hydra or pgdm would obey but that are refused, and the reason given to the user."""
_TYPED = ("hydra.searchpath", "sweep.most_jobs")
"""Keys of ``_REFUSED`` that a user may nevertheless type on the command line."""
_HANDLING = {"handlers", "formatters", "filters", "loggers"}
_SHELL = ("setup", "additional_parameters")
"""Keys of a launcher whose values are passed to a shell or a command line."""


def check_settings(settings: object, where: str, typed: bool = False) -> None:
    """Refuse settings that would run code, and those that only the command line may set.

    Args:
        settings: plain containers; their keys may be dotted, as in overrides.
        where: the file or command line that they come from, for the message.
        typed: whether the user has typed them.

    Raises:
        ConfigError: if a key is refused; the message names ``where`` and the key.
    """
    for key in _keys(settings, ""):
        for refused, reason in _REFUSED.items():
            if f"{key}.".startswith(f"{refused}.") and not (typed and refused in _TYPED):
                raise ConfigError(f"{where}: {key} is refused ({reason}); leave it out")
        if key.endswith("_target_"):
            raise ConfigError(
                f"{where}: {key} is refused (settings may not name code to run); leave it out"
            )


def _keys(value: object, path: str) -> Iterator[str]:
    """Yield the dotted key of every value; of an override ``group@package``, the package."""
    yield path
    if isinstance(value, Mapping):
        for name, inner in value.items():
            key = str(name).lstrip("+~").replace("/", ".").rpartition("@")[2]
            yield from _keys(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for inner in value:
            yield from _keys(inner, path)
    elif isinstance(value, str) and "_target_" in value:  # a mapping written as a string
        yield f"{path}._target_"


def check_file(file: Path) -> None:
    """Check a file of settings that does not come with pgdm, before Hydra reads it.

    Raises:
        ConfigError: if it cannot be read, or has a key that is refused; the message names the file
            and the key.
    """
    try:
        settings = files.read_yaml(file)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {files.reason(error)}") from error
    check_settings(settings, str(file))


def check_composed(hydra: Mapping[str, Any], typed: Sequence[str]) -> None:
    """Check Hydra's own settings after composition, since any file can set any of their keys.

    Args:
        hydra: the settings under ``hydra``.
        typed: overrides that the user has typed.

    Raises:
        ConfigError: if they have callbacks or log handlers, or if they have shell commands that the
            user has not typed.
    """
    if hydra.get("callbacks"):
        raise ConfigError("hydra.callbacks is refused (it names code to run); leave it out")
    for name in ("job_logging", "hydra_logging"):
        if _HANDLING & set(hydra.get(name) or ()):
            raise ConfigError(f"hydra.{name} is refused (pgdm sets up its own logging)")
    for key in _SHELL:
        value = (hydra.get("launcher") or {}).get(key)
        if value and not any(
            text.lstrip("+").startswith(f"hydra.launcher.{key}=") for text in typed
        ):
            raise ConfigError(
                f"a file sets hydra.launcher.{key} to {value}, which runs commands; if you trust "
                f"it, type it: 'hydra.launcher.{key}=[...]'"
            )


def check_method(settings: Mapping[str, Any], where: str) -> None:
    """Refuse settings whose method is in a module that the user has neither imported nor trusted.

    Args:
        settings: of a run; only a ``method.name`` of the form ``module:attribute`` is imported.
        where: where they come from, for the message.

    Raises:
        ConfigError: if the module is not trusted; the message says how to trust it.
    """
    module = _module(settings)
    if module is not None and module not in sys.modules and module not in _trusted():
        raise ConfigError(
            f"{where} names a method of the module '{module}', which would be imported; if you "
            f"trust it, repeat the command with {TRUSTED}={module} before it"
        )


def trust_method(settings: Mapping[str, Any]) -> None:
    """Trust the module of a method: in this process, in those it starts and in later commands."""
    if (module := _module(settings)) is None or module in _trusted():
        return
    os.environ[TRUSTED] = ",".join(sorted(_trusted() | {module}))
    with contextlib.suppress(OSError):  # the environment suffices for this command
        paths.user().mkdir(parents=True, exist_ok=True)
        with open(_list(), "a", encoding="utf-8") as file:
            file.write(f"{module}\n")


def named_methods(typed: Sequence[str], folders: Sequence[Path]) -> set[str]:
    """Return each ``method.name`` that the user's overrides choose.

    Args:
        typed: overrides that the user has typed; several values are separated by commas.
        folders: the user's settings folders, which may hold a method's file.
    """
    words: dict[str, set[str]] = {"method": set(), "method.name": set()}
    for key, _, values in (text.lstrip("+").partition("=") for text in typed):
        words.get(key, set()).update(value.strip(" '\"") for value in values.split(","))
    for file in (f / "method" / f"{name}.yaml" for f in folders for name in words["method"]):
        with contextlib.suppress(OSError, ValueError):
            content = files.read_yaml(file)
            if isinstance(content, Mapping):
                words["method.name"].add(str(content.get("name")))
    return words["method.name"]


def _module(settings: Mapping[str, Any]) -> str | None:
    """Return the module that a ``method.name`` of the form ``module:attribute`` names."""
    method = settings.get("method")
    name = str(method.get("name") if isinstance(method, Mapping) else None)
    return name.partition(":")[0] if ":" in name else None


def _list() -> Path:
    return paths.user() / "methods.txt"


def _trusted() -> set[str]:
    known = set(os.environ.get(TRUSTED, "").split(","))
    with contextlib.suppress(OSError, ValueError):
        known |= set(files.read_text(_list()).split())
    return known - {""}
