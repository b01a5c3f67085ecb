"""The flags of ``pgdm-run``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pgdm.errors import ConfigError, UnknownNameError

_SHORT = {
    "-h": "--help",
    "-m": "--multirun",
    "-c": "--cfg",
    "-p": "--package",
    "-i": "--info",
    "-cd": "--config-dir",
    "-sc": "--shell-completion",
}
_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
# Flags that take a value, and the valid values (None: any).
_VALUES: dict[str, tuple[str, ...] | None] = {
    "--cfg": ("job", "hydra", "all"),
    "--package": None,
    "--config-dir": None,
    "--info": _INFO,
}
_OURS = ("--help", "--version", "--debug", "--offline", "--dry-run")
DRY_RUN = "sweep.dry_run=true"
"""The override that ``--dry-run`` adds; only sweeps read it."""
_HYDRAS = ("--multirun", "--resolve", "--hydra-help", "--shell-completion")
_PRINTING = {"--cfg", "--info", "--resolve", "--hydra-help", "--shell-completion"}


@dataclass
class Flags:
    """A parsed command line."""

    ours: set[str] = field(default_factory=set)
    """The flags of ``_OURS`` that were given."""
    hydras: list[str] = field(default_factory=list)
    """Flags that are passed on to Hydra, and their values."""
    overrides: list[str] = field(default_factory=list)
    """The overrides: ``key=value``."""
    typed: list[str] = field(default_factory=list)
    """Overrides that do not come from a sweep file; ``pgdm.cli.run`` sets this."""
    config_dir: str | None = None
    """The user's own settings folder."""

    @property
    def multirun(self) -> bool:
        """Whether the command line is a sweep."""
        return "--multirun" in self.hydras or "hydra.mode=MULTIRUN" in self.overrides

    @property
    def prints(self) -> bool:
        """Whether Hydra only prints something and nothing is run."""
        return not _PRINTING.isdisjoint(self.hydras)


def read_flags(arguments: Sequence[str]) -> Flags:
    """Parse a command line.

    Raises:
        ConfigError: if a flag is unknown, or its value is missing or not valid.
    """
    flags, waiting = Flags(), list(arguments)
    while waiting:
        token = waiting.pop(0)
        if not token.startswith("-"):
            flags.overrides.append(token)
            continue
        name, joined, value = token.partition("=")
        name = _SHORT.get(name, name)
        if name in _VALUES:
            _add_with_value(flags, name, value if joined else None, waiting)
        elif joined or name not in (*_OURS, *_HYDRAS):
            raise UnknownNameError("flag", token, [*_OURS, *_HYDRAS, *_VALUES])
        elif name in _OURS:
            flags.ours.add(name)
        else:
            flags.hydras.append(name)
    for flag, override in (("--offline", "offline=true"), ("--dry-run", DRY_RUN)):
        if flag in flags.ours:
            flags.overrides.append(override)
    return flags


def _add_with_value(flags: Flags, name: str, value: str | None, waiting: list[str]) -> None:
    valid = _VALUES[name]
    if name == "--info" and value is None and (not waiting or waiting[0] not in _INFO):
        value = "all"
    if value is None:
        if not waiting or waiting[0].startswith("-"):
            choice = f": {' or '.join(valid)}" if valid else ""
            raise ConfigError(f"{name} needs a value{choice}")
        value = waiting.pop(0)
    if valid is not None and value not in valid:
        raise UnknownNameError(f"{name} value", value, valid)
    if name == "--config-dir":
        flags.config_dir = value
    flags.hydras += [name, value]
