"""Fabricated runs of a few tasks and settings, and the report on them."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from pgdm.config.compose import compose_plain
from pgdm.report.page import write_report
from pgdm.report.runs import ERROR, METRICS, SUCCESS, Run
from pgdm.report.settings import Setting
from pgdm.runs.folder import RunFolder
from pgdm.runs.log import RunLog

FRAMES = 40_960


def make(
    path: Path,
    success: float,
    *overrides: str,
    state: str = "finished",
    result: Mapping[str, Any] | None = None,
    **changes: Any,
) -> RunFolder:
    """Write a run whose last evaluation has a success, sampled; the mean action has 0.1 more.

    Args:
        path: its folder.
        success: of the last of four evaluations; the first has none.
        overrides: settings, as for ``pgdm-run``; the task must be one of them.
        state: status in ``result.json``; a ``running`` run has no such file.
        result: more keys of ``result.json``.
        changes: of top-level keys of the configuration, known or not.
    """
    config = compose_plain([f"total_frames={FRAMES}", "budget=smoke", *overrides]) | changes
    (path / "videos").mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump({"format": 1, **config}))
    total, metrics = config["total_frames"], {}
    log = RunLog(path / "metrics.jsonl")
    for i in range(5):
        place = {"frames": total * i // 4, "iteration": i, "time_s": float(i)}
        log.append({"train/return": 10.0 * i, "train/kl": 0.1}, kind="train", **place)
        metrics = evaluation(success * i / 4)
        log.append(metrics, kind="eval", **place)
    film = path / "videos" / f"frames_{total:012d}.mp4"
    film.write_bytes(b"film")
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(film.with_suffix(".png"))
    content = {"status": state, "frames": total, "metrics": metrics, "git": "0123abc"}
    content |= {"pregrasp_used": config["pregrasp"]["source"], "versions": {"mujoco": "4.0.0"}}
    content |= {"error": "the disk is full"} if state == "failed" else {}
    if state != "running":
        (path / "result.json").write_text(json.dumps(content | dict(result or {})))
    return RunFolder(path)


def curve_run(
    setting: Setting,
    task: str,
    points: Mapping[int, float],
    seed: int = 0,
    state: str = "finished",
    **facts: Any,
) -> Run:
    """Return a run with evaluations of these successes: frames to success.

    Its error is (1 - success) / 100; its task is one of tcdm30.
    """
    success = np.array(list(points.values()))
    values = {SUCCESS: success, ERROR: (1 - success) / 100}
    return Run(
        path=Path(f"{hash(setting)}/{task}/{seed}"),
        **{"state": state, "setting": setting, "task": task, "seed": seed, "frames": max(points)},
        budget="smoke",
        facts={"tcdm30": True, "paper_success": 0.9} | facts,
        result={},
        metrics={name: float(curve[-1]) for name, curve in values.items()},
        evaluations={"frames": np.array(list(points), float)}
        | {name: values.get(name, success) for name in METRICS},
        **{"training": {}, "video": None, "modified": 0.0},
    )


def evaluation(success: float) -> dict[str, float]:
    """Return an evaluation's metrics; the errors follow from the success."""
    found = {}
    for kind, more in (("sampled", 0.0), ("deterministic", 0.1)):
        named = {"success": success + more, "com_error_released": 1e-2 * math.exp(-success)}
        named |= {"ori_error": 1.0 - success, "lifted": 0.5, "return": 3.0}
        found |= {f"eval_{kind}/{name}": value for name, value in named.items()}
    return found


def report(*places: Path | str, out: Path | None = None) -> str:
    """Write the report on some folders, by default to ``out``, and return its page."""
    folder = out or Path("out")
    page, _ = write_report([str(place) for place in places], folder, lambda *_: None)
    return page.read_text(encoding="utf-8")


def rows(name: str, out: Path | str = "out") -> list[dict[str, str]]:
    """Return a table of a report."""
    with open(Path(out) / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def text_of(page: str) -> str:
    """Return the text of a page without its tags, on one line."""
    body = re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", body).split())
