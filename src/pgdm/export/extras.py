"""Packages that only exports need."""

from __future__ import annotations

from importlib.util import find_spec

from pgdm.errors import ConfigError


def check_installed(what: str, *packages: str) -> None:
    """Check that packages of the extra ``export`` are installed.

    Args:
        what: what needs them, for the message.
        packages: their import names.

    Raises:
        ConfigError: if a package is missing.
    """
    for package in packages:
        if find_spec(package) is None:
            raise ConfigError(
                f"{what} needs the package {package}: pip install -c constraints.txt -e '.[export]'"
            )
