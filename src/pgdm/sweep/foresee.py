"""What the runs of a sweep would meet in this machine's assets, told before any of them starts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from pgdm.config.schema import ExperimentCfg
from pgdm.experiment import foreseen, wanted_start
from pgdm.library import Library, figures, rebuild
from pgdm.methods import recipe
from pgdm.pregrasp.sources import stored_source


def foresee(cfgs: Iterable[ExperimentCfg], library: Library) -> list[str]:
    """Return sentences on starts and assets that are not as asked for.

    Args:
        cfgs: of the runs.
        library: nothing is fetched or made for it here.

    Raises:
        ConfigError: if the start of a run is missing, and would not be made.
    """
    replaced: Counter[tuple[str, str]] = Counter()
    lacking, approximate, planned = set(), set(), set()
    for cfg in cfgs:
        motion = cfg.task.motion
        if cfg.action.plans_wrist:
            planned.add(motion)
        if recipe(cfg.method).needs_expert and motion in rebuild.TASKS:
            approximate.add(motion)
        if motion not in library.tasks():
            lacking |= {motion} & set(figures.OTHER_TASKS)
        elif cfg.pregrasp.source != "none" and not wanted_start(cfg, library).can_be_made:
            used = stored_source(cfg.pregrasp, library.motion(motion), cfg.task.id, cfg.hand.name)
            if used is None:
                foreseen(cfg, library)  # raises with the cure
            elif used != cfg.pregrasp.source:
                replaced[cfg.pregrasp.source, used] += 1
    found = [
        f"{count} runs with pregrasp={source} start from '{used}', as the assets here have no "
        f"'{source}' of their tasks (a TCDM checkout has, and 'pgdm pregrasp reach TASK' plans one)"
        for (source, used), count in replaced.items()
    ]
    if planned:
        found.append(
            f"the wrist is planned in {len(planned)} tasks: a run whose plan the library lacks "
            "computes it first, 10-40 s each"
        )
    if lacking:
        names = ", ".join(sorted(lacking))
        found.append(f"only a TCDM checkout has these tasks, and none was imported here: {names}")
    if approximate:
        names = ", ".join(sorted(approximate))
        found.append(f"the expert hands of these tasks are rebuilt, and approximate: {names}")
    return found
