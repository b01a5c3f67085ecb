"""Names in playbacks and options, in a module that loads fast."""

from __future__ import annotations

from pathlib import Path

from pgdm.errors import ConfigError, check_name

COMMANDED, REACHED = "commanded", "reached"
BASES = (COMMANDED, REACHED)
SUFFIXES = (".npz", ".csv")


def check_suffix(path: Path) -> None:
    """Check the suffix of a playback's file name.

    Raises:
        ConfigError: if it is neither ``.npz`` nor ``.csv``.
    """
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"'{path}': give a name that ends in {' or '.join(SUFFIXES)}")


def check_base(name: str) -> None:
    """Check a value of ``--base``.

    Raises:
        UnknownNameError: if it is not in ``BASES``.
    """
    check_name("--base", name, BASES)
