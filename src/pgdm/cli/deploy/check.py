"""``pgdm deploy check``: check the format of a playback, and that it respects the arm's limits."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from pgdm.cli.console.screen import console
from pgdm.deploy import limits
from pgdm.deploy.playback import Playback, read
from pgdm.errors import amount


def run_check(file: Path) -> int:
    """Print what a playback holds and which limits it exceeds; return the exit code.

    Raises:
        ConfigError: if the file's name ends in neither .npz nor .csv.
        PlaybackError: if the file is damaged or not a playback.
    """
    playback = read(file)
    used = limits.usage(playback.time_s, playback.arm_joints_rad)
    describe(file, playback, used)
    return 1 if used.violations else 0


def describe(file: Path, playback: Playback, used: limits.Usage) -> None:
    """Print a playback's content, how much of the arm's limits it uses, and all violations."""
    say = partial(console().print, soft_wrap=True, markup=False, highlight=False)
    count, hand = len(playback.time_s), len(playback.hand_joints)
    task = playback.facts.get("task", "no task")
    parts = f"{count} samples, {amount(hand, 'hand joint')}"
    say(f"{file}: {task}, {playback.duration_s:.2f} s, {parts}")
    room = used.share["position"]
    say(f"position: at least {room.min():.3f} rad from its limits ({_joint(-room)})")
    for name in ("velocity", "acceleration", "jerk"):
        share = used.share[name]
        say(f"{name}: {100 * share.max():.0f}% of its limit ({_joint(share)})")
    for violation in used.violations:
        say(f"violation: {violation.described}")
    if used.violations and used.slower < 1:
        say(f"velocity, acceleration and jerk are within limits at {used.slower:.2f} of this speed")


def _joint(share: np.ndarray) -> str:
    return limits.JOINTS[int(share.argmax())]
