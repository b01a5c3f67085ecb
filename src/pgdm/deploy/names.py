"""Names in playbacks and options, checked before anything slow is loaded."""

from __future__ import annotations

from pathlib import Path

from pgdm.errors import ConfigError, check_name

COMMANDED, REACHED = "commanded", "reached"
BASES = (COMMANDED, REACHED)
SUFFIXES = (".npz", ".csv")


def check_suffix(path: Path) -> None:
    """Check the ending of a playback's name.

    Raises:
        ConfigError: if it is neither ``.npz`` nor ``.csv``.
    """
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"'{path}': give a name that ends in {' or '.join(SUFFIXES)}")


def check_base(name: str) -> None:
    """Check which motion of the base is meant.

    Raises:
        UnknownNameError: if there is no such.
    """
    check_name("--base", name, BASES)
