"""Suites: named lists of tasks, either explicit or selected by keys in the tasks' files."""

from __future__ import annotations

import fnmatch
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pgdm import files
from pgdm.config.groups import available, folders
from pgdm.errors import ConfigError, UnknownNameError, amount

_log = logging.getLogger(__name__)

_WILD = "*?["


def suites(config_dir: str | Path | None = None) -> dict[str, Path]:
    """Return the suites' files by name; pgdm's takes precedence over a user's of equal name."""
    own_last = [f for folder in folders(config_dir) for f in (folder / "suite").glob("*.yaml")]
    found = {file.stem: file for file in reversed(own_last)}
    return dict(sorted(found.items()))


def suite(name: str, config_dir: str | Path | None = None) -> tuple[str, ...]:
    """Return the tasks of a suite, in its order.

    Raises:
        UnknownNameError: if there is no such suite, or it names a task that does not exist.
        ConfigError: if its file is wrong.
    """
    if name not in suites(config_dir):
        raise UnknownNameError("suite", name, suites(config_dir))
    return expand_tasks([name], config_dir)


def expand_tasks(words: Iterable[str], config_dir: str | Path | None = None) -> tuple[str, ...]:
    """Return the tasks that ``words`` name, each once, in the order of their first mention.

    Args:
        words: each a task, a suite, a pattern such as ``dhand-*``, or one of these after a minus,
            which removes its tasks from those named before.
        config_dir: a folder of the user's own settings to search as well.

    Raises:
        UnknownNameError: if a word is none of these.
        ConfigError: if the file of a suite is wrong.
    """
    return tuple(_Expansion(config_dir).tasks(words, ()))


def check_task(name: str) -> None:
    """Check the name of one task.

    Raises:
        ConfigError: if there is no such task; for a suite or a pattern, the message says how to
            run it.
    """
    if name not in available("task"):
        raise unknown_task(name, None)


def unknown_task(name: str, config_dir: str | Path | None) -> ConfigError:
    """Return the error for a name that should be a single task but is not."""
    if name in suites(config_dir):
        size = len(suite(name, config_dir))
        return ConfigError(
            f"{name} is a suite of {amount(size, 'task')}; to run them all: pgdm-run -m task={name}"
        )
    if "*" in name:
        return ConfigError(
            f"'{name}' is a pattern for several tasks; to run them all: pgdm-run -m 'task={name}'"
        )
    return UnknownNameError("task", name, [*available("task", config_dir), *suites(config_dir)])


class _Expansion:
    """The available tasks and suites, read once."""

    def __init__(self, config_dir: str | Path | None) -> None:
        self.folders = folders(config_dir)
        self.all = available("task", config_dir)
        self.suites = suites(config_dir)

    def tasks(self, words: Iterable[str], inside: tuple[str, ...]) -> list[str]:
        found: dict[str, None] = {}  # a set that keeps its order
        for word in words:
            for task in self._one(word.removeprefix("-"), inside):
                if word.startswith("-"):
                    found.pop(task, None)
                else:
                    found[task] = None
        return list(found)

    def _one(self, word: str, inside: tuple[str, ...]) -> Sequence[str]:
        if word in self.all:
            return [word]
        if word in self.suites:
            return self._suite(word, inside)
        matches = fnmatch.filter(self.all, word) if any(c in word for c in _WILD) else []
        if not matches:
            raise UnknownNameError("task or suite", word, [*self.all, *self.suites])
        return matches

    def _suite(self, name: str, inside: tuple[str, ...]) -> Sequence[str]:
        file = self.suites[name]
        if name in inside:
            raise ConfigError(f"{file}: the suite '{name}' contains itself; name its tasks")
        content = _read(file)
        tasks, where = content.get("tasks"), content.get("where")
        if isinstance(tasks, list) and where is None:
            return self.tasks(map(str, tasks), (*inside, name))
        if isinstance(where, dict) and tasks is None:
            return [task for task in self.all if self._fits(task, where)]
        raise ConfigError(f"{file}: a suite has either tasks: [...] or where: {{key: value}}")

    def _fits(self, task: str, where: dict[str, Any]) -> bool:
        places = [folder / "task" / f"{task}.yaml" for folder in self.folders]
        try:
            facts = task_facts(next(file for file in places if file.is_file()))
        except ConfigError as error:  # a user's wrong file must not block the other tasks
            _log.warning("task '%s' is left out of suites: %s", task, error)
            return False
        return all(
            facts.get(key) is not None if value == "any" else facts.get(key) == value
            for key, value in where.items()
        )


def task_facts(file: Path) -> dict[str, Any]:
    """Return the keys in a task's file; ``hand`` is the hand in its defaults list."""
    content = _read(file)
    for entry in content.pop("defaults", None) or []:
        for key, option in entry.items() if isinstance(entry, dict) else ():
            if "/hand" in str(key):
                content["hand"] = option
    return content


def _read(file: Path) -> dict[str, Any]:
    try:
        content = files.read_yaml(file) or {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {files.reason(error)}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{file} holds no keys")
    return content
