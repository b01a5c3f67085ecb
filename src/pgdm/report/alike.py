"""Find runs of one setting that differ in start state, assets or scene."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from pgdm.report.results import Results
from pgdm.report.runs import Run
from pgdm.report.settings import Setting

# Name on the page -> key in result.json. The values depend on the assets of the machine.
_FACTS = {"start": "pregrasp_used", "asset source": "asset_source"}


class Mixed(NamedTuple):
    """A fact in which the finished runs of a setting differ."""

    setting: Setting
    fact: str
    counts: dict[str, int]
    """Value to number of runs."""


class Double(NamedTuple):
    """A run that is left out: another one of the same setting, task and seed counts instead."""

    run: Run
    differences: list[str]
    """Facts in which it differs from the run that counts."""


def mixed(results: Results) -> list[Mixed]:
    """Return the facts in which finished runs of a setting differ; unrecorded facts are ignored."""
    found = []
    for setting in results.settings:
        runs = [_facts(run) for run in results.runs if run.setting == setting and run.finished]
        for fact in dict.fromkeys(fact for facts in runs for fact in facts):
            counts = Counter(facts[fact] for facts in runs if fact in facts)
            if len(counts) > 1:
                found.append(Mixed(setting, fact, dict(counts.most_common())))
    return found


def left_out(results: Results) -> list[Double]:
    """Return the runs that are left out, those that differ from the counted run first."""
    counted = {(run.setting, run.task, run.seed): run for run in results.runs}
    found = []
    for run in results.doubles:
        own, other = _facts(run), _facts(counted[run.setting, run.task, run.seed])
        differences = [
            f"{fact} {own[fact]}, not {other[fact]}"
            for fact in own
            if fact in other and own[fact] != other[fact]
        ]
        found.append(Double(run, differences))
    return sorted(found, key=lambda double: not double.differences)


def _facts(run: Run) -> dict[str, str]:
    """Return the facts that a run recorded.

    The fact of a scene is named after asset source and task: only scenes of the same asset source
    and task are comparable.
    """
    found = {fact: run.result.get(key) for fact, key in _FACTS.items()}
    if (scene := run.result.get("scene_sha256")) is not None:
        found[f"{found['asset source']} {run.task} scene"] = str(scene)[:8]
    return {fact: str(value) for fact, value in found.items() if value is not None}
