"""``pgdm deploy simulate``: play a playback on a simulated arm and hand; film it, print results."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pgdm.cli.console.screen import bars, console, notify
from pgdm.cli.scenes import composed
from pgdm.config.suites import check_task
from pgdm.deploy.arm import Setup
from pgdm.deploy.playback import Playback, PlaybackError, read
from pgdm.deploy.simulate import LIFTED_M, Outcome, arm_scene, simulate, start_of
from pgdm.library import ensure
from pgdm.library.arms import ensure_panda
from pgdm.library.progress import StepProgress
from pgdm.sim.draw import Shots, draw
from pgdm.sim.render import write_video
from pgdm.sim.scene import OBJECT_MASSES, Scene

_FPS = 10  # of the video, which plays in real time


@dataclass(frozen=True)
class SimulateRequest:
    """What to simulate."""

    file: Path
    boxes: int
    seed: int
    video: Path | None
    offline: bool


def run_simulate(request: SimulateRequest) -> int:
    """Play a playback open-loop, print the outcome and, if asked to, film the first object.

    Raises:
        PgdmError: if the file is not a playback or does not fit its task, assets cannot be fetched,
            or nothing can be drawn.
    """
    with bars() as progress:
        playback, scene, outcome = simulated(request, progress)
        _print(outcome)
        if request.video is not None:
            _film(request.video, scene, playback, outcome, progress)
            print(f"video: {request.video}")
    return 0


def simulated(request: SimulateRequest, progress: StepProgress) -> tuple[Playback, Scene, Outcome]:
    """Play a playback open-loop; return the playback, the scene and the outcome.

    Raises:
        PgdmError: as for `run_simulate`.
    """
    playback = read(request.file)
    try:
        task, hand, mass, setup = _facts(playback)
        cfg = composed(task, hand, f"sim.object_mass={mass}", offline=request.offline)
        arm = ensure_panda(request.offline, notify, progress=progress)
        library = ensure(cfg.task.motion, request.offline, notify, progress=progress)
        progress("compiling the scene", 0, 1)
        scene = arm_scene(library, cfg, arm, setup)
        start = start_of(playback, scene, len(playback.hand_joints) + cfg.hand.num_base_joints)
    except PlaybackError as error:
        raise PlaybackError(f"{request.file}: {error}") from error
    count = request.boxes if cfg.task.randomize else 1
    report = partial(progress, "simulation")
    return playback, scene, simulate(scene, playback, start, count, request.seed, 0, report)


def _facts(playback: Playback) -> tuple[str, str, str, Setup]:
    task, hand, stored = (playback.facts.get(key) for key in ("task", "hand", "setup"))
    if not isinstance(task, str) or not isinstance(hand, str) or not isinstance(stored, dict):
        raise PlaybackError("its facts lack task, hand or setup, so it cannot be simulated")
    check_task(task)
    mass = playback.facts.get("object_mass", "volume")
    if mass not in OBJECT_MASSES:
        raise PlaybackError(f"its object_mass is not one of {', '.join(OBJECT_MASSES)}")
    try:
        arm_at, height, mount = (stored[k] for k in ("arm_at", "table_height_m", "mount"))
        if len(arm_at) != 3 or len(mount) != 6:
            raise ValueError("arm_at needs 3 numbers, mount 6")
        numbers = [tuple(map(float, arm_at)), float(height), tuple(map(float, mount))]
    except (KeyError, TypeError, ValueError) as error:
        raise PlaybackError(f"its setup is not valid ({error})") from error
    return task, hand, mass, Setup.of(hand, *numbers)


def _print(outcome: Outcome) -> None:
    say = partial(console().print, soft_wrap=True, markup=False, highlight=False)
    end, count = outcome.height_m[-1], len(outcome.held)
    say(f"open-loop on {count} object(s), {outcome.time_s[-1]:.2f} s")
    say(f"held at the end: {int(outcome.held.sum())} of {count} ({100 * outcome.held.mean():.0f}%)")
    if outcome.held.any():
        high = end[outcome.held]
        say(
            f"held objects end {100 * np.mean(high):.1f} cm above start ({100 * high.min():.1f} to "
            f"{100 * high.max():.1f}); in the exported episode {100 * outcome.expected_m:.1f} cm"
        )
    say(f"time above {100 * LIFTED_M:.0f} cm: {outcome.lifted_s.mean():.2f} s on average")
    degrees = np.degrees(outcome.arm_error_rad.max())
    say(f"largest lag of an arm joint behind its command: {degrees:.2f} degrees")
    if outcome.diverged.any():
        say(f"diverged: {int(outcome.diverged.sum())} of {count}")


def _film(
    path: Path, scene: Scene, playback: Playback, outcome: Outcome, progress: StepProgress
) -> None:
    stride = max(1, round(1 / _FPS / float(outcome.time_s[1])))
    rows = np.arange(0, len(outcome.time_s), stride)
    captions = [
        f"{scene.task.id}  open-loop  {outcome.time_s[i]:.2f} s  "
        f"{100 * outcome.height_m[i, 0]:.1f} cm up"
        for i in rows
    ]
    arm = scene.model.body("panda/link0").pos + np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.8]])
    seen = np.concatenate((playback.object_pos_m, arm))
    shots = Shots(scene.model, scene.index.object_body, seen, outcome.qpos[rows], captions)
    pictures = []
    for picture in draw(shots):
        progress("drawing", len(pictures), len(rows))
        pictures.append(picture)
    write_video(path, pictures, _FPS)
