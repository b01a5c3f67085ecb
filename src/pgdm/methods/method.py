"""The class of methods, and finding a method by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.mdp.recipe import Recipe
from pgdm.methods.pgdm import MethodCfg


@dataclass(frozen=True)
class Method:
    """A method: the class of its settings and the function that turns them into a recipe."""

    config: type[MethodCfg]
    """Frozen dataclass of the group ``method``; it has at least the keys of ``MethodCfg``."""
    recipe: Callable[[Any], Recipe]
    """Turns an instance of ``config`` into its recipe."""


def find(name: str, methods: Mapping[str, Method]) -> Method:
    """Return a method by its name or, for a user's own method, by its location.

    Args:
        name: a key of ``methods``, or ``my_package.module:attribute``, which is imported.
        methods: the named methods.

    Raises:
        UnknownNameError: if there is no method of that name.
        ConfigError: if the location is malformed, the module cannot be imported, or it has no such
            `Method`.
    """
    if ":" in name:
        return _imported(name)
    if name not in methods:
        hint = "Your own method is given as my_package.module:attribute"
        raise UnknownNameError("method.name value", name, methods, hint)
    return methods[name]


def _imported(name: str) -> Method:
    module_name, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), attribute)):
        raise ConfigError(f"method.name '{name}' is not of the form my_package.module:attribute")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        found = error.name is None or not f"{module_name}.".startswith(f"{error.name}.")
        cure = (
            "the module exists, but something it imports does not: correct that import"
            if found
            else "install its package, or add its folder to PYTHONPATH"
        )
        raise ConfigError(
            f"method.name '{name}': cannot import '{module_name}' ({error}); {cure}"
        ) from error
    except SyntaxError as error:
        place = f"{error.filename}, line {error.lineno}" if error.filename else module_name
        raise ConfigError(f"method.name '{name}': {place}: {error.msg}") from error
    except SystemExit as error:
        raise ConfigError(
            f"method.name '{name}': importing '{module_name}' ends Python (exit code "
            f"{error.code}); a module with a method must not"
        ) from error
    found = getattr(module, attribute, None)
    if not isinstance(found, Method):
        there = [key for key, value in vars(module).items() if isinstance(value, Method)]
        raise ConfigError(
            f"method.name '{name}': '{attribute}' of {module.__file__} is not a "
            f"pgdm.methods.Method; it has: {', '.join(there) or 'none'}"
        )
    if not (isinstance(found.config, type) and issubclass(found.config, MethodCfg)):
        raise ConfigError(
            f"method.name '{name}': config of the Method is {found.config!r}; it must be a frozen "
            "dataclass derived from pgdm.methods.MethodCfg"
        )
    return found
