"""What a method is, and how one is found by its name."""

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
    """A way of making an MDP: the class of its settings, and what it makes of them."""

    config: type[MethodCfg]
    """Frozen dataclass of the group ``method``; it has at least the keys of ``MethodCfg``."""
    recipe: Callable[[Any], Recipe]
    """From an instance of ``config`` to the terms."""


def find(name: str, methods: Mapping[str, Method]) -> Method:
    """Return a method by its name, or by the place of a user's own one.

    Args:
        name: a key of ``methods``, or ``my_package.module:attribute``, which is imported.
        methods: those that have a name.

    Raises:
        UnknownNameError: if there is no method of that name.
        ConfigError: if there is no such module, or no `Method` in it.
    """
    if ":" in name:
        return _imported(name)
    if name not in methods:
        hint = "A method of your own is written as my_package.module:attribute"
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
            "mend it: the module is there, but not all that it imports"
            if found
            else "install its package, or name the folder it lies in with PYTHONPATH"
        )
        raise ConfigError(
            f"method.name '{name}': cannot import '{module_name}' ({error}); {cure}"
        ) from error
    found = getattr(module, attribute, None)
    if not isinstance(found, Method):
        there = [key for key, value in vars(module).items() if isinstance(value, Method)]
        raise ConfigError(
            f"method.name '{name}': '{attribute}' of {module.__file__} is not a "
            f"pgdm.methods.Method; it has: {', '.join(there) or 'none'}"
        )
    return found
