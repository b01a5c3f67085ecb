"""Studies: sweeps stored as files that hold the overrides to type after ``pgdm-run -m``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from pgdm import files, paths
from pgdm.config.foreign import check_settings
from pgdm.config.groups import conf_dir, folders
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.paths import as_name

_KEY = "+sweep"

# Settings that say which jobs run, where, how fast or how often. Names of sweeps omit them, and
# names of jobs omit all but task and seed.
NOT_IN_A_NAME = (
    "task", "seed", "sweep", "hydra", "run_dir", "resume", "offline", "num_threads", "device",
    "tracking", "checkpoint",
)  # fmt: skip


def studies(config_dir: str | Path | None = None) -> dict[str, Path]:
    """Return the sweep files by name; pgdm's file hides a user's of the same name."""
    # pgdm's sweep files are next to conf/, both in a checkout and in an installed package.
    places = [conf_dir().parent, *folders(config_dir)[1:]]
    own_last = [file for folder in places for file in (folder / "sweeps").glob("*.yaml")]
    return dict(sorted((file.stem, file) for file in reversed(own_last)))


def open_study(
    overrides: Sequence[str], config_dir: str | Path | None = None
) -> tuple[str | None, list[str], list[str]]:
    """Read the sweep file that ``+sweep=NAME`` names.

    Returns:
        The name of the sweep file, or None; the overrides without ``+sweep``; and the overrides in
        the sweep file, which must be applied first.

    Raises:
        UnknownNameError: if there is no such sweep file.
        ConfigError: if several sweep files are given, or the file is wrong.
    """
    named = [o.partition("=")[2] for o in overrides if o.partition("=")[0] == _KEY]
    typed = [o for o in overrides if o.partition("=")[0] != _KEY]
    for override in typed:
        key, _, value = override.partition("=")
        if key == "sweep" and (value in studies(config_dir) or value.endswith(".yaml")):
            raise ConfigError(f"a sweep file is added with a plus: {_KEY}={value}")
    if not named:
        return None, typed, []
    if len(named) > 1:
        raise ConfigError(f"{_KEY} is given {len(named)} times; start one sweep at a time")
    file = _find(named[0], config_dir)
    return file.stem, typed, _read(file)


def default_name(overrides: Sequence[str], study: str | None) -> str:
    """Return the name of a sweep for which ``sweep.name`` is not set.

    It depends on the sweep file and the overrides, but neither on tasks nor on seeds: a command
    with more tasks or seeds extends the same sweep. The other keys in ``NOT_IN_A_NAME`` do not
    count either.

    Args:
        overrides: overrides as typed.
        study: name of the sweep file, if any.
    """
    given = {o.partition("=")[0]: o.partition("=")[2] for o in overrides}
    rest = {
        key: value
        for key, value in sorted(given.items())
        if re.split(r"[./@]", key.lstrip("+~"))[0] not in NOT_IN_A_NAME
    }
    parts = [study or "grid"]
    if "budget" in rest:
        parts.append(rest.pop("budget"))
    if rest:
        text = "-".join(rest.values())[:40]
        digest = hashlib.sha256(repr(sorted(rest.items())).encode()).hexdigest()[:6]
        parts += [text, digest]
    return as_name("-".join(parts))


def _find(name: str, config_dir: str | Path | None) -> Path:
    known = studies(config_dir)
    if name in known:
        return known[name]
    file = paths.expanded(name) if name.startswith("~") else Path(name)
    if file.suffix in (".yaml", ".yml") and file.is_file():
        return file
    raise UnknownNameError("sweep file", name, known)


def _read(file: Path) -> list[str]:
    try:
        content = files.read_yaml(file)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {files.reason(error)}") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigError(f"{file} is not a sweep file; write lines such as task: tcdm30")
    check_settings(content, str(file))
    return [f"{key}={_value(value, file)}" for key, value in content.items()]


def _value(value: object, file: Path) -> str:
    """Return a value as one would type it; a list holds the values to try."""
    if isinstance(value, dict):
        raise ConfigError(f"{file}: write nested keys in one line, such as algo.clip: 0.1")
    if isinstance(value, list):
        return ",".join(_text(item) for item in value)
    return _text(value)


def _text(value: object) -> str:
    if isinstance(value, list):
        return f"[{','.join(_text(item) for item in value)}]"
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    return str(value)
