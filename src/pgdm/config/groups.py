"""Which settings there are to choose from, read from ``conf/`` without loading anything heavy."""

from __future__ import annotations

from pathlib import Path

from pgdm import paths
from pgdm.errors import ConfigError, UnknownNameError

_PACKAGE = Path(__file__).resolve().parents[1]

# Folders of conf/ that Hydra reads for itself, or that are no choice of a run.
_NO_GROUPS = ("hydra", "suite", "sweeps")


def conf_dir() -> Path:
    """Return the folder of the settings: inside an installed package, else the repository's.

    Raises:
        ConfigError: if the installation lacks it.
    """
    for folder in (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise ConfigError(
        f"the settings (conf/config.yaml) are missing beside {_PACKAGE}; install pgdm anew"
    )


def folders(config_dir: str | Path | None) -> list[Path]:
    """Return the folders of settings: pgdm's, then the user's own ones."""
    return [conf_dir(), *own_folders(config_dir)]


def own_folders(config_dir: str | Path | None) -> list[Path]:
    """Return the user's folders of settings: the one named for this command, then the lasting one.

    Hydra looks into them in this order.
    """
    lasting = [paths.user_conf()] if paths.user_conf().is_dir() else []
    return lasting if config_dir is None else [Path(config_dir), *lasting]


def check_own(config_dir: str | Path | None) -> None:
    """Refuse the user's files that have the group and name of one of pgdm's.

    Hydra finds pgdm's first, and would take it without a word.

    Raises:
        ConfigError: at the first one; names both files.
    """
    ours = conf_dir()
    # The sweep files lie beside conf/.
    files = {file.relative_to(ours): file for file in ours.glob("*/**/*.yaml")}
    sweeps = ours.parent / "sweeps"
    files |= {file.relative_to(ours.parent): file for file in sweeps.glob("*.yaml")}
    for folder in own_folders(config_dir):
        for name, file in files.items():
            own = folder / name
            if own.is_file() and not own.samefile(file):
                raise ConfigError(
                    f"{own} has the name of pgdm's {file}, which would be used in its place; "
                    "give yours another name"
                )


def groups(config_dir: str | Path | None = None) -> list[str]:
    """Return the names of the config groups, such as ``task``."""
    names = {
        path.name
        for folder in folders(config_dir)
        if folder.is_dir()
        for path in folder.iterdir()
        if path.is_dir() and path.name[0] not in "._" and path.name not in _NO_GROUPS
    }
    return sorted(names)


def available(group: str, config_dir: str | Path | None = None) -> list[str]:
    """Return the options of a config group, such as the tasks for ``task``.

    Args:
        group: name of the group.
        config_dir: a folder of the user's own settings to look into besides.

    Raises:
        UnknownNameError: if there is no such group.
    """
    known = groups(config_dir)
    if group not in known:
        raise UnknownNameError("config group", group, known)
    names = {
        path.stem
        for folder in folders(config_dir)
        for path in (folder / group).glob("*.yaml")
        if not path.name.startswith("_")
    }
    return sorted(names)
