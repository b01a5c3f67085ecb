"""Compute the start states of the animated tasks: ``python tools/animated_starts.py [TASK...]``.

For each file in src/pgdm/library/keyframes: the object settles on the table, a contact-free hand
pose near the object is searched (pgdm.pregrasp.near), and the joint positions of both are written
into the file as ``start``. Needs a library with hands and objects. Prints the result and draws it
into the folder for temporary files.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

from pgdm.author import TaskRequest
from pgdm.author.motion import MotionRequest, make_motion
from pgdm.author.pregrasp import make_pregrasp
from pgdm.author.task import AuthoredTask, task_scene
from pgdm.cli.author.task import film_panels
from pgdm.library import animated, open_library
from pgdm.library.checks.motion import object_joints
from pgdm.library.manifest import TaskEntry
from pgdm.library.progress import silent
from pgdm.sim.sheet import write_sheet

DIGITS = 4


def find(task: str, pictures: Path) -> None:
    """Write a task's start state into its file."""
    path = animated.FOLDER / f"{task}.yaml"
    text = path.read_text(encoding="utf-8").split("# Where hand and object start")[0].rstrip()
    content = yaml.safe_load(text)
    content.pop("start", None)
    hand, name = content.pop("hand"), content.pop("object")
    with tempfile.TemporaryDirectory() as folder:
        keyframes = Path(folder) / f"{task}.yaml"
        keyframes.write_text(yaml.safe_dump(content), encoding="utf-8")
        motion = MotionRequest(keyframes, None)
        request = TaskRequest(f"{task}-start", name, hand, motion)  # pgdm has the task already
        library = open_library()
        entry = TaskEntry(hand, [name], 0, ["mined"])
        scene = task_scene(request, library.promising(request.id, entry))
        body = scene.index.object_body
        made = make_motion(motion, library.object_xml(name), scene.model, body)
    qpos = np.zeros(scene.model.nq)
    qpos[scene.model.nu :] = object_joints(scene.model, body, made.poses)[0]
    found = make_pregrasp(request.pregrasp, scene, qpos, made.poses, library, silent)
    print(task, *made.notes, *found.notes, sep="\n  ")
    nu = scene.model.nu
    start = {"hand": found.qpos[:nu], "object": found.qpos[nu:]}
    lines = [f"  {key}: [{', '.join(_number(v) for v in value)}]" for key, value in start.items()]
    wrapped = re.sub(r"(.{60,92}?,) ", r"\1\n    ", "\n".join(lines))
    comment = "# Where hand and object start [m, rad]; found by tools/animated_starts.py."
    path.write_text(f"{text}\n{comment}\nstart:\n{wrapped}\n", encoding="utf-8")
    author = AuthoredTask(task, scene, made, found, None, path, path)
    write_sheet(scene, film_panels(author), pictures / f"{task}.png")


def _number(value: float) -> str:
    return f"{round(value, DIGITS) + 0.0:.{DIGITS}f}"  # no -0.0000


if __name__ == "__main__":
    for name in sys.argv[1:] or animated.TASKS:
        find(name, Path(tempfile.gettempdir()))
