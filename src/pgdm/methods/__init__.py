"""Methods: each turns a configuration into a Recipe. One row each."""

from __future__ import annotations

from collections.abc import Callable

from pgdm.errors import UnknownNameError
from pgdm.mdp.recipe import Recipe
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg

METHODS: dict[str, Callable[[MethodCfg], Recipe]] = {
    "pgdm": pgdm.recipe,
}


def recipe(cfg: MethodCfg) -> Recipe:
    """Return the configured method's Recipe.

    Raises:
        UnknownNameError: if there is no such method.
    """
    if cfg.name not in METHODS:
        raise UnknownNameError("method", cfg.name, METHODS)
    return METHODS[cfg.name](cfg)


__all__ = ["METHODS", "MethodCfg", "recipe"]
