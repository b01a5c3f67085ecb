"""Measure how many interactions per second the labeler handles, with a page open in a browser.

python benchmark/labeler.py writes benchmark/results/labeler.json python benchmark/labeler.py
--picture FILE.jpg writes the documentation's picture instead

An interaction is one change of a slider or handle: joints, forward kinematics, contacts and
distances are computed, and the scene is sent to the page. The labeler runs on one core; the browser
renders in software, without a GPU.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from chromium import Chromium, Tab, browser
from PIL import Image
from rich.console import Console

from pgdm.config.compose import compose
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.pregrasp.labeler import shapes
from pgdm.pregrasp.labeler.page import LabelPage
from pgdm.pregrasp.labeler.poses import Draft, Poses

TASKS = ("hammer-use1", "dhand-cup", "dmanus-crackerbox")
INTERACTIONS = 300
PATIENCE_S = 120.0
RESULT = Path(__file__).parent / "results" / "labeler.json"
QUALITY = 82


def opened(task: str, origin: str) -> tuple[LabelPage, Draft]:
    """Serve a task's labeler."""
    builder = env_builder(compose([f"task={task}", "pregrasp=none"]), open_library())
    scene, motion = builder.scene, builder.motion
    poses, draft = Poses(scene, motion), Draft(scene)
    looks = shapes.visible(scene), shapes.solid(scene)
    return LabelPage(scene, poses, poses.load(origin), draft, looks, motion.substeps, 0), draft


def look_at(chrome: Chromium, page: LabelPage) -> Tab:
    """Open a page and wait until hand and object are rendered."""
    tab = chrome.tab()
    tab.open(page.url, "fingertips to the object")
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        with Image.open(io.BytesIO(tab.picture())) as picture:
            seen = np.asarray(picture.convert("RGB"))[200:600, 200:800].reshape(-1, 3)
        if len(np.unique(seen // 8, axis=0)) > 100:  # an empty page has only a few colours
            return tab
    raise TimeoutError("the page was not rendered")


def moves(page: LabelPage) -> dict[str, Callable[[float], None]]:
    """Return the interactions, each a function of its amplitude from -1 to 1."""
    state = page.state
    pos, quat = state.kinematics.wrist_pose(state.qpos)
    tip = state.kinematics.tip(state.qpos, 0)
    knuckle = state.kinematics.fingers[0].joints[1]
    height, bent = float(state.qpos[1]), float(state.qpos[knuckle])
    up = np.array([0.0, 0.0, 1.0])
    return {
        "wrist slider": lambda x: page.set_joint(1, height + 0.02 * x, "wrist slider"),
        "finger slider": lambda x: page.set_joint(knuckle, bent + 0.3 * x, "finger slider"),
        "wrist handle": lambda x: page.drag_wrist(pos + 0.02 * x * up, quat, "update"),
        "fingertip handle": lambda x: page.drag_tip(0, tip + 0.01 * x * up, "update"),
    }


def measure(page: LabelPage, move: Callable[[float], None]) -> tuple[float, float]:
    """Return interactions per second of wall time, and of the labeler's CPU time."""
    began, used = time.perf_counter(), time.process_time()
    for i in range(INTERACTIONS):
        move(float(np.sin(0.3 * i)))
        page.mailbox.wait()  # so that no change is skipped
    page.server.flush()
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - used
    return INTERACTIONS / wall_s, INTERACTIONS / cpu_s


def run(chrome: Chromium, console: Console) -> dict[str, Any]:
    """Measure all tasks."""
    rates: dict[str, Any] = {}
    for task in TASKS:
        with console.status(f"{task}: starting"):
            page, draft = opened(task, "planned")
            tab = look_at(chrome, page)
        rates[task] = {}
        for name, move in moves(page).items():
            with console.status(f"{task}: {name}"):
                wall, cpu = measure(page, move)
            rates[task][name] = {"per_s": round(wall, 1), "per_s_of_one_core": round(cpu, 1)}
            console.print(f"{task} {name}: {wall:.0f}/s, {cpu:.0f} per core-second")
        tab.wait("document.body.innerText.includes('fingertips')")  # the page still responds
        tab.close()
        page.close()
        draft.close()
    return rates


def take_picture(chrome: Chromium, path: Path) -> None:
    """Write the picture for the documentation, with the hand slightly too low."""
    page, draft = opened("hammer-use1", "planned")
    pos, quat = page.state.kinematics.wrist_pose(page.state.qpos)
    for phase in ("start", "update", "end"):
        page.drag_wrist(pos - np.array([0.0, 0.0, 0.018]), quat, phase)
    page.mailbox.wait()
    tab = look_at(chrome, page)
    tab.script("document.querySelector('#webgl-software-rendering button')?.click()")
    time.sleep(10.0)  # until the warning has disappeared and everything is rendered
    with Image.open(io.BytesIO(tab.picture())) as picture:
        picture.convert("RGB").save(path, quality=QUALITY, optimize=True)
    page.close()
    draft.close()
    print(f"{path}: {path.stat().st_size // 1024} KiB")


def main() -> None:
    """Measure, or write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="Write the picture instead.")
    chosen = parser.parse_args()
    console = Console()
    with tempfile.TemporaryDirectory() as user, browser() as chrome:
        os.environ["PGDM_USER_DIR"] = user
        if chosen.picture is not None:
            return take_picture(chrome, chosen.picture)
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # of this process, not the browser
        rates = run(chrome, console)
    load = os.getloadavg()[0]
    result = {"interactions": INTERACTIONS, "cores": 1, "load": round(load, 1), "tasks": rates}
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(f"wrote {RESULT}")


if __name__ == "__main__":
    main()
