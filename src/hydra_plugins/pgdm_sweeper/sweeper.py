"""The sweeper plugin; Hydra imports it at every start, so nothing heavy stands at its top."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hydra.plugins.sweeper import Sweeper

if TYPE_CHECKING:
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig


class PgdmSweeper(Sweeper):
    """Hands the settings of every job to the task function, all of them composed before the first.

    Args:
        params: values to sweep over, as on the command line; the command line's own win.
    """

    def __init__(self, params: Mapping[str, Any]) -> None:
        self._given = [f"{key}={value}" for key, value in params.items()]

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Take what Hydra has made of the command line so far."""
        self._loader, self._whole = hydra_context.config_loader, config
        self._task_function = task_function

    def sweep(self, arguments: list[str]) -> list[Any]:
        """Expand the arguments, compose each job, and return what the task function returned."""
        from hydra.core.hydra_config import HydraConfig
        from omegaconf import read_write

        from pgdm.sweep.expand import composed_jobs

        HydraConfig.instance().set_config(self._whole)
        hydra: Any = HydraConfig.get()
        results = []
        for overrides, job in composed_jobs(self._loader, self._whole, [*self._given, *arguments]):
            with read_write(hydra):
                hydra.overrides.task = list(overrides)
            results.append(self._task_function(job))
        return results
