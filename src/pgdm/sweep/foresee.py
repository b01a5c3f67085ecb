"""Report which assets the runs of a sweep lack on this machine, before any of them starts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pgdm.config.schema import ExperimentCfg
from pgdm.errors import amount
from pgdm.library import Library
from pgdm.library.progress import StepProgress, silent
from pgdm.library.tasks import CHECKOUT_TASKS, REBUILT_EXPERTS
from pgdm.methods import recipe
from pgdm.pregrasp.sources import stored_source


def foresee(
    cfgs: Sequence[ExperimentCfg], library: Library, progress: StepProgress = silent
) -> list[str]:
    """Return sentences on start states and assets that are missing, replaced or approximate.

    One more sentence says how many tasks need a wrist plan.

    Args:
        cfgs: settings of the runs.
        library: the assets on this machine; nothing is fetched or generated here.
        progress: called with the number of runs looked at so far.

    Raises:
        ConfigError: if a start state is missing, has no stored substitute and cannot be generated
            automatically.
    """
    replaced: Counter[tuple[str, str]] = Counter()
    used_by: dict[object, str] = {}
    lacking, approximate, planned = set(), set(), set()
    for number, cfg in enumerate(cfgs):
        progress("looking for the runs' assets", number, len(cfgs))
        motion = cfg.task.motion
        if cfg.action.plans_wrist:
            planned.add(motion)
        if recipe(cfg.method).needs_expert and motion in REBUILT_EXPERTS:
            approximate.add(motion)
        if motion not in library.tasks():
            lacking |= {motion} & set(CHECKOUT_TASKS)
        elif (source := cfg.pregrasp.source) != "none":
            start = cfg.task.id, motion, cfg.hand.name, cfg.pregrasp
            if start not in used_by:
                used_by[start] = _used(cfg, library)
            if used_by[start] != source:
                replaced[source, used_by[start]] += 1
    found = [
        f"pregrasp={source}: {amount(count, 'run')} will start from '{used}', since no '{source}' "
        "start of the task is stored here (a TCDM checkout has it, or 'pgdm pregrasp reach TASK' "
        "plans it)"
        for (source, used), count in replaced.items()
    ]
    if planned:
        found.append(
            f"{amount(len(planned), 'task')} with a wrist plan; a run whose plan the library lacks "
            "computes it first, which takes 10-40 s"
        )
    if lacking:
        names = ", ".join(sorted(lacking))
        found.append(f"only a TCDM checkout has these tasks, and none was imported here: {names}")
    if approximate:
        names = ", ".join(sorted(approximate))
        found.append(f"the experts of these tasks are reconstructed and only approximate: {names}")
    return found


def _used(cfg: ExperimentCfg, library: Library) -> str:
    """Return the source of the start state that a run will use.

    Raises:
        ConfigError: if there is no start state; the message names the command that generates it.
    """
    source = cfg.pregrasp.source
    used = stored_source(cfg.pregrasp, library.motion(cfg.task.motion), cfg.task.id, cfg.hand.name)
    if used == source:
        return source
    from pgdm.experiment import foreseen, wanted_start  # slow to import, and seldom needed

    if wanted_start(cfg, library).can_be_made:
        return source
    if used is None:
        foreseen(cfg, library)
    return str(used)
