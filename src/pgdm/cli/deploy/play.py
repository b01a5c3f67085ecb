"""``pgdm deploy play``: play a playback on a real arm."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from pgdm.cli.console.screen import bars, notify
from pgdm.deploy.limits import JOINTS
from pgdm.deploy.playback import read
from pgdm.deploy.player import Player, check_playable
from pgdm.stop import StopRequest


def run_play(file: Path, robot: str | None, move: bool, realtime: bool) -> int:
    """Check a playback, connect, and move the arm if asked to; return the exit code.

    Raises:
        PgdmError: if the file is not a playback or exceeds the arm's limits, or the arm cannot be
            reached, refuses to move or lags too far behind.
    """
    playback = read(file)
    check_playable(playback)
    print(f"{file}: {playback.duration_s:.2f} s, within the limits of the arm")
    if robot is None:
        print("dry run: no arm was contacted (--robot HOST connects, --move moves it)")
        return 0
    player = Player(robot, realtime)
    away = np.abs(player.joints - playback.arm_joints_rad[0])
    print(f"{robot}: farthest from the start is {JOINTS[int(away.argmax())]}, {away.max():.2f} rad")
    if not move:
        print("dry run: nothing was moved (--move moves the arm)")
        return 0
    with StopRequest() as stop:
        notify("moving to the start, slowly; Ctrl-C stops the arm")
        if not player.approach(playback, stop):
            return stop.exit_code
        with bars() as progress:
            played = player.play(playback, stop, partial(progress, "playing"))
    worst = JOINTS[int(played.lag_rad.argmax())]
    print(f"played {played.time_s:.2f} s; largest lag {played.lag_rad.max():.3f} rad ({worst})")
    return 0 if played.whole else stop.exit_code
