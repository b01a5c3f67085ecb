"""Methods: each turns its settings into a recipe. Users' methods need no entry in ``METHODS``."""

from __future__ import annotations

from pgdm.errors import ConfigError
from pgdm.mdp.recipe import Recipe
from pgdm.methods import curriculum, deepmimic, full, graff, pgdm
from pgdm.methods.method import Method, find
from pgdm.methods.pgdm import MethodCfg

METHODS: dict[str, Method] = {
    "pgdm": Method(MethodCfg, pgdm.recipe),
    "deepmimic": Method(deepmimic.DeepMimicCfg, deepmimic.recipe),
    "graff": Method(graff.GraffCfg, graff.recipe),
    "curriculum": Method(curriculum.CurriculumCfg, curriculum.recipe),
    "full": Method(full.FullCfg, full.recipe),
}


def config_class(name: str) -> type[MethodCfg]:
    """Return the class of a method's settings.

    Raises:
        ConfigError: if there is no such method, or a user's own cannot be imported.
    """
    return find(name, METHODS).config


def recipe(cfg: MethodCfg) -> Recipe:
    """Return the configured method's Recipe.

    Raises:
        ConfigError: if there is no such method, or its recipe function ends Python or returns
            anything but a Recipe.
    """
    try:
        made = find(cfg.name, METHODS).recipe(cfg)
    except SystemExit as error:
        raise ConfigError(
            f"method.name '{cfg.name}': its recipe function ends Python (exit code {error.code}); "
            "it must not"
        ) from error
    if not isinstance(made, Recipe):
        raise ConfigError(
            f"method.name '{cfg.name}': its recipe function returns {made!r:.60}; it must return a "
            "pgdm.mdp.recipe.Recipe"
        )
    return made


__all__ = ["METHODS", "Method", "MethodCfg", "config_class", "recipe"]
