"""Versions and git revision behind a result, and whether a checkpoint fits the current assets."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgdm.errors import RunError

if TYPE_CHECKING:  # these load the simulator and torch
    from pgdm.envs.build import EnvBuilder
    from pgdm.library.progress import Notify

PACKAGES = ("pgdm", "mujoco", "torch", "torchrl", "tensordict", "numpy", "gymnasium", "hydra-core")


def versions() -> dict[str, str]:
    """Return the versions of Python and of ``PACKAGES``."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_revision() -> str | None:
    """Return the git revision of the source, with ``+`` if the package has uncommitted changes.

    None if the source is not in a git checkout, or git cannot be run.
    """
    here = Path(__file__).resolve().parents[1]  # the whole package
    try:
        revision = _git(here, "rev-parse", "HEAD")
        return revision + ("+" if _git(here, "status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def check_assets(
    recorded: Mapping[str, Any], builder: EnvBuilder, where: Path, notify: Notify
) -> None:
    """Check that a checkpoint was trained with the current assets.

    Other versions of MuJoCo or PyTorch are only reported.

    Raises:
        RunError: if other assets were used; the message names what differs.
    """
    for difference in builder.differences(recorded):
        raise RunError(
            f"{where} was trained with {difference}; restore the library ('pgdm assets list' shows "
            "it, 'pgdm assets fetch' adds the source registry, 'pgdm assets import PATH' the "
            "source checkout), or start anew in another run_dir"
        )
    before, now = recorded.get("versions", {}), versions()
    for package in ("mujoco", "torch"):
        if before.get(package) != now[package]:
            notify(
                f"{where} was trained with {package} {before.get(package)}, but "
                f"{now[package]} is installed: from here on the results are not bit-exact"
            )


def _git(folder: Path, *command: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *command], capture_output=True, text=True, check=True, timeout=10
    )
    return done.stdout.strip()
