"""Playing on an arm: refusals, and a whole playback against a simulator of the arm's protocol."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pgdm.cli.main import main
from pgdm.deploy.playback import Playback, write
from test_deploy_files import READY, playback

needs_arm = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("franky", "franky_sim")),
    reason="needs franky-control and franky-sim",
)


def moving(seconds: float) -> Playback:
    """Return a playback in which joint 1 turns by 0.2 rad."""
    count = int(100 * seconds) + 1
    still = playback(count)
    joints = np.tile(READY, (count, 1))
    joints[:, 0] = 0.1 - 0.1 * np.cos(np.pi * still.time_s / seconds)
    return replace(still, arm_joints_rad=joints)


def test_without_an_arm_it_is_a_dry_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(tmp_path / "a.npz")
    write(tmp_path / "a.npz", moving(2.0))
    assert main(["deploy", "play", file]) == 0
    assert "no arm was contacted" in capsys.readouterr().out
    assert main(["deploy", "play", file, "--move"]) == 2
    assert capsys.readouterr().err == "error: --move needs --robot HOST\n"


def test_what_the_arm_cannot_do_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.npz", moving(0.1))
    assert main(["deploy", "play", str(tmp_path / "a.npz"), "--robot", "127.0.0.1", "--move"]) == 2
    error = capsys.readouterr().err
    assert "the arm cannot play this: joint1: velocity" in error


@pytest.fixture(scope="module")
def arm() -> Iterator[str]:
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("franka_server.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdin is not None and server.stdout is not None
    with server:
        yield server.stdout.readline().strip()
        server.stdin.close()


@needs_arm
@pytest.mark.slow
def test_a_playback_moves_a_simulated_arm(
    tmp_path: Path, arm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "a.npz")
    wanted = moving(3.0)
    write(tmp_path / "a.npz", wanted)
    command = ["deploy", "play", file, "--robot", arm, "--no-realtime"]
    assert main(command) == 0
    assert "dry run: nothing was moved" in capsys.readouterr().out
    assert main([*command, "--move"]) == 0
    assert "played 3.00 s" in capsys.readouterr().out

    from pgdm.deploy.player import Player

    player = Player(arm, realtime=False)
    np.testing.assert_allclose(player.joints, wanted.arm_joints_rad[-1], atol=0.05)
    assert not player.approach(wanted, stop=lambda: True)  # stopped on the way
    assert player.joints[0] > wanted.arm_joints_rad[0, 0] + 0.1
    assert player.approach(wanted)
    answers = iter([False] * 100)
    stopped = player.play(wanted, stop=lambda: next(answers, True))
    assert not stopped.whole and 0.1 < stopped.time_s < 2.5
