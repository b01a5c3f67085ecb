"""The available settings, read from ``conf/`` without slow imports."""

from __future__ import annotations

from pathlib import Path

from pgdm import paths
from pgdm.errors import ConfigError, UnknownNameError

_PACKAGE = Path(__file__).resolve().parents[1]

GROUPS = {
    "method": "method.name",
    "ablation": "ablation.name",
    "pregrasp": "pregrasp.source",
    "action": "action.kind",
    "algo": "algo.name",
    "shaping": "shaping.name",
    "obs": "obs.layout",
    "reference": "reference.frame",
    "hand": "hand.name",
}
"""Config group to the key that holds the name of the chosen option."""

# Folders in conf/ that are not config groups of a run.
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
        f"the settings (conf/config.yaml) are missing next to {_PACKAGE}; reinstall pgdm"
    )


def folders(config_dir: str | Path | None) -> list[Path]:
    """Return the folders of settings: pgdm's, then the user's."""
    return [conf_dir(), *own_folders(config_dir)]


def own_folders(config_dir: str | Path | None) -> list[Path]:
    """Return the user's folders of settings in Hydra's order of search.

    First ``config_dir``, then the permanent one, ``paths.user_conf()``.
    """
    lasting = [paths.user_conf()] if paths.user_conf().is_dir() else []
    return lasting if config_dir is None else [Path(config_dir), *lasting]


def check_own(config_dir: str | Path | None) -> None:
    """Refuse a file of the user's that has the group and name of one of pgdm's.

    Hydra finds pgdm's file first, and would silently use it instead.

    Raises:
        ConfigError: at the first such file; the message names both files.
    """
    ours = conf_dir()
    # The sweep files are in a folder next to conf/.
    files = {file.relative_to(ours): file for file in ours.glob("*/**/*.yaml")}
    sweeps = ours.parent / "sweeps"
    files |= {file.relative_to(ours.parent): file for file in sweeps.glob("*.yaml")}
    for folder in own_folders(config_dir):
        for name, file in files.items():
            own = folder / name
            if own.is_file() and not own.samefile(file):
                raise ConfigError(
                    f"{own} has the name of pgdm's {file}, which would be used instead; "
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
        config_dir: a folder of the user's own settings to search as well.

    Raises:
        UnknownNameError: if there is no such group.
    """
    known = groups(config_dir)
    if group not in known:
        raise UnknownNameError("config group", group, known)
    return sorted({path.stem for path in _files(group, config_dir) if unusable(path) is None})


def unreadable(group: str, config_dir: str | Path | None = None) -> dict[Path, str]:
    """Return the files of a config group that cannot be options, each with the reason."""
    reasons = {path: unusable(path) for path in _files(group, config_dir)}
    return {path: reason for path, reason in reasons.items() if reason is not None}


def unusable(path: Path) -> str | None:
    """Return why a file cannot be an option, or None."""
    if not path.is_file():
        return "a link that leads nowhere" if path.is_symlink() else "not a file"
    try:
        paths.check_path_part("its name", path.stem)
    except ConfigError as error:
        return str(error)
    return None


def _files(group: str, config_dir: str | Path | None) -> list[Path]:
    found = [path for one in folders(config_dir) for path in sorted((one / group).glob("*.yaml"))]
    return [path for path in found if not path.name.startswith("_")]
