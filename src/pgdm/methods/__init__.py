"""Methods: each turns its settings into a Recipe. One row each; users' own ones need none."""

from __future__ import annotations

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
        ConfigError: if there is no such method.
    """
    return find(name, METHODS).config


def recipe(cfg: MethodCfg) -> Recipe:
    """Return the configured method's Recipe.

    Raises:
        ConfigError: if there is no such method.
    """
    return find(cfg.name, METHODS).recipe(cfg)


__all__ = ["METHODS", "Method", "MethodCfg", "config_class", "recipe"]
