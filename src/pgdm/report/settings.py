"""A run's configuration, except task and seed, as deviations from the paper's settings."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from pgdm.config.compose import PAPER_FRAMES, compose_plain
from pgdm.config.describe import describe
from pgdm.config.groups import GROUPS, available, conf_dir
from pgdm.config.identity import changes_result
from pgdm.runs.config_file import dotted


@dataclass(frozen=True)
class Setting:
    """The configuration shared by runs that differ only in task and seed."""

    options: tuple[tuple[str, str], ...]
    """Config group and chosen option; without the hand if it is the task's own hand."""
    changes: tuple[str, ...]
    """Overrides of pgdm's defaults, which are the paper's settings."""
    total_frames: int
    """Length of the training in frames."""

    def option(self, group: str) -> str:
        """Return the option of a group."""
        return dict(self.options).get(group, "?")

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.option("method")

    @property
    def with_pregrasp(self) -> bool:
        """Whether episodes start at a pre-grasp."""
        return self.option("pregrasp") != "none"

    @property
    def plain(self) -> bool:
        """Whether it is PGDM with pre-grasps and no ablation, as in the paper's values by task."""
        return self.method == "pgdm" and self.option("ablation") == "none" and self.with_pregrasp

    @property
    def own_hand(self) -> bool:
        """Whether each task uses the hand that its settings file names, as in the paper."""
        return not self.within("hand")

    def within(self, *groups: str) -> tuple[str, ...]:
        """Return the changes within some config groups."""
        return tuple(c for c in self.changes if re.split("[.=]", c)[0] in groups)

    def rest(self, *groups: str) -> tuple[str, ...]:
        """Return the changes outside some config groups, and the number of frames as text."""
        own = self.within(*groups)
        return *(c for c in self.changes if c not in own), f"{self.total_frames:,} frames"

    def deviations(self, *groups: str) -> list[str]:
        """Return why its results are not comparable with the paper's; empty if they are.

        Args:
            groups: config groups whose option the paper's table varies too; their options are no
                deviations.
        """
        frames = self.total_frames
        fewer = [f"{frames:,} of {PAPER_FRAMES:,} frames"] if frames < PAPER_FRAMES else []
        return [*fewer, *(c for c in self.changes if c.split("=")[0] not in groups)]


def setting_of(config: Mapping[str, Any], out_of_time: bool = False) -> Setting:
    """Return the setting of a run's configuration.

    Args:
        config: configuration as plain containers.
        out_of_time: whether the time limit stopped the run; the limit then counts as a change, so
            that the run is not averaged with those that trained for all their frames.
    """
    flat = {
        key: value
        for key, value in dotted(config).items()
        if changes_result(key) and key not in ("seed", "format") and not key.startswith("task.")
    }
    task = config.get("task")
    own_hand = _hand_of(str(task.get("id")) if isinstance(task, Mapping) else "")
    if own_hand in (None, flat.get("hand.name")):
        flat = {key: value for key, value in flat.items() if not key.startswith("hand.")}
    chosen = {group: str(flat[key]) for group, key in GROUPS.items() if key in flat}
    usual = _composed(frozenset())
    other = {g: option for g, option in chosen.items() if option != usual.get(GROUPS[g])}
    base = _composed(frozenset((g, o) for g, o in other.items() if o in available(g)))
    options = [f"{group}={option}" for group, option in other.items()]
    names = GROUPS.values()
    rest = [
        f"{key}={_text(value)}"
        for key, value in flat.items()
        if key not in names and not _equal(value, base.get(key))
    ]
    if out_of_time:
        rest.append(f"time_limit_min={_text(config.get('time_limit_min'))}")
    total = config.get("total_frames")
    frames = total if isinstance(total, int) else 0
    return Setting(tuple(chosen.items()), (*options, *rest), frames)


def shared(settings: Sequence[Setting]) -> tuple[str, ...]:
    """Return the changes that several settings have in common, except the method's name."""
    first, *others = settings
    common = (c for c in first.changes if all(c in other.changes for other in others))
    return tuple(c for c in common if others and not c.startswith("method="))


def labels(settings: Sequence[Setting]) -> dict[Setting, str]:
    """Return short names that distinguish settings, without the changes that all of them share."""
    common = shared(settings)
    lengths = {s.total_frames for s in settings}
    found = {}
    for setting in settings:
        own = [c for c in setting.changes if c not in common]
        parts = [setting.method, *(c for c in own if not c.startswith("method="))]
        if len(lengths) > 1:
            parts.append(f"{setting.total_frames:,} frames")
        found[setting] = ", ".join(parts)
    return found


@cache
def _composed(options: frozenset[tuple[str, str]]) -> dict[str, Any]:
    return dotted(compose_plain([f"{group}={option}" for group, option in sorted(options)]))


@cache
def _hand_of(task: str) -> str | None:
    """Return the hand of one of pgdm's tasks; None for other tasks."""
    file = conf_dir() / "task" / f"{task}.yaml"
    if not task or not file.is_file():
        return None
    return next((o for group, o in describe(file).defaults.items() if "/hand" in group), None)


def _equal(a: Any, b: Any) -> bool:
    return a == b or str(a) == str(b)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
