"""Addresses of MLflow stores: checked, and made absolute, before anything is written there."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from urllib.parse import urlsplit

from pgdm.errors import ConfigError

VARIABLE = "MLFLOW_TRACKING_URI"
_SCHEME = re.compile(r"([A-Za-z][\w.+-]*):(.*)")
_DATABASES = ("postgresql", "mysql", "mssql")
_VALID = "valid: http://HOST:PORT, sqlite:///FILE, postgresql://USER@HOST/NAME"


def chosen(uri: str | None, key: str, notify: Callable[[str], object]) -> str | None:
    """Return the store that the user names: ``uri``, else ``MLFLOW_TRACKING_URI``, else None.

    Args:
        uri: address as the user wrote it; None or empty if not given.
        key: the setting or option that ``uri`` comes from, for messages.
        notify: called with a sentence if the environment variable is used.

    Raises:
        ConfigError: as for `absolute`.
    """
    if uri:
        return absolute(uri, key)
    given = os.environ.get(VARIABLE, "").strip()
    if not given:
        return None
    found = absolute(given, f"the environment's {VARIABLE}")
    notify(f"{VARIABLE} is set: MLflow's store is {_shown(found)}; {key}=... overrides it")
    return found


def absolute(uri: str, key: str) -> str:
    """Return the address of a store; a relative file is resolved against the working directory.

    Raises:
        ConfigError: if MLflow cannot use the store; the message names ``key`` and valid addresses.
    """
    text = uri.strip()
    match = _SCHEME.fullmatch(text)
    scheme, rest = (match[1].lower(), match[2]) if match else ("", text)
    kind = scheme.partition("+")[0]
    try:
        if kind == "sqlite":
            return _sqlite(rest)
        if kind in ("", "file") and text != "databricks":
            return _folder(rest)
        if kind in ("http", "https"):
            _check_server(f"{kind}:{rest}")
        elif kind in _DATABASES:
            _check_database(f"{scheme}:{rest}")
        elif text != "databricks" and scheme not in ("databricks", *_plugins()):
            raise ValueError(f"MLflow has no stores of the kind '{scheme}'")
    except (ValueError, ImportError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{key} is '{_shown(uri)}': {reason}; {_VALID}") from error
    return f"{scheme}:{rest}" if scheme else text


def _shown(uri: str) -> str:
    """Return an address without its password."""
    return re.sub(r"(//[^/@:]*):[^@]*@", r"\1:***@", uri)


def _sqlite(rest: str) -> str:
    path, mark, options = rest.removeprefix("///").partition("?")
    if not rest.startswith("///") or path in ("", ":memory:"):
        raise ValueError("a SQLite store is a file, after three slashes")
    file = os.path.abspath(os.path.expanduser(path))
    if os.path.isdir(file):
        raise ValueError(f"{file} is a folder, not a file")
    return f"sqlite:///{file}{mark}{options}"


def _folder(rest: str) -> str:
    path = os.path.abspath(os.path.expanduser(re.sub("^//(localhost)?(?=/)", "", rest)))
    # MLflow's own switch, for users who have to keep an old store.
    if os.environ.get("MLFLOW_ALLOW_FILE_STORE", "").lower() in ("true", "1"):
        return Path(path).as_uri()
    raise ValueError(
        "MLflow no longer writes plain folders; for a database in that folder give "
        f"sqlite:///{path}/mlflow.db"
    )


def _check_server(uri: str) -> None:
    parts = urlsplit(uri)
    if not parts.hostname or re.search(r"\s", uri):
        raise ValueError("it names no host")
    _ = parts.port  # reading the port checks it


def _check_database(uri: str) -> None:
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        make_url(uri).get_dialect().import_dbapi()
    except ArgumentError as error:  # also if there is no such dialect
        raise ValueError(str(error)) from error


def _plugins() -> list[str]:
    return [plugin.name for plugin in entry_points(group="mlflow.tracking_store")]
