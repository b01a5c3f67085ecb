"""Runs that count as alike by what was asked for, and were not made alike."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from pgdm.report.results import Results
from pgdm.report.runs import Run
from pgdm.report.settings import Setting

# What a reader is told -> the key in a run's result. It depends on the machine's assets.
_FACTS = {"start": "pregrasp_used", "asset source": "asset_source"}


class Mixed(NamedTuple):
    """A fact in which finished runs of one setting differ."""

    setting: Setting
    fact: str
    counts: dict[str, int]
    """Value to runs."""


class Double(NamedTuple):
    """A run that is left out."""

    run: Run
    differences: list[str]
    """In what it was made otherwise than the one that counts."""


def mixed(results: Results) -> list[Mixed]:
    """Return in what the finished runs of settings differ; what a run does not tell is no value."""
    found = []
    for setting in results.settings:
        made = [_made(run) for run in results.runs if run.setting == setting and run.finished]
        for fact in dict.fromkeys(fact for facts in made for fact in facts):
            counts = Counter(facts[fact] for facts in made if fact in facts)
            if len(counts) > 1:
                found.append(Mixed(setting, fact, dict(counts.most_common())))
    return found


def left_out(results: Results) -> list[Double]:
    """Return the runs of which another one counts, those that were made otherwise first."""
    counted = {(run.setting, run.task, run.seed): run for run in results.runs}
    found = []
    for run in results.doubles:
        own, other = _made(run), _made(counted[run.setting, run.task, run.seed])
        differences = [
            f"{fact} {own[fact]}, not {other[fact]}"
            for fact in own
            if fact in other and own[fact] != other[fact]
        ]
        found.append(Double(run, differences))
    return sorted(found, key=lambda double: not double.differences)


def _made(run: Run) -> dict[str, str]:
    """Return what a run tells of the facts.

    A scene is compared with those of the same task and source only: others differ anyway.
    """
    told = {fact: run.result.get(key) for fact, key in _FACTS.items()}
    if (scene := run.result.get("scene_sha256")) is not None:
        told[f"{told['asset source']} {run.task} scene"] = str(scene)[:8]
    return {fact: str(value) for fact, value in told.items() if value is not None}
