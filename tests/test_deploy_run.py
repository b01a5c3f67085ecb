"""From a run to a verdict, with the commands of the documentation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from conftest import DOWNLOADS, fetched_wheel
from pgdm.cli.main import main
from pgdm.cli.run import main as train
from pgdm.deploy.playback import read
from pgdm.library.robohive.fill import PACKAGE


@pytest.mark.slow
def test_a_run_is_exported_simulated_and_studied(
    own_library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fetched_wheel(PACKAGE)  # has the arm
    (own_library.parent / "downloads").symlink_to(DOWNLOADS)
    run, file = tmp_path / "lift", tmp_path / "lift.npz"
    short = "total_frames=4096 eval.episodes=2 eval.video=false tracking=none budget=smoke"
    wrist = "action=residual action.wrist_path=planned action.hold_steps=3 action.carry_load=true"
    words = f"task=dmanus-sim2real algo=ppo_fast {wrist} {short} run_dir={run}".split()
    assert train(words) == 0

    export = ["deploy", "export", str(run), "--episodes", "64", "--out", str(file)]
    assert main([*export, "--speed", "3"]) == 1  # far too fast
    said = capsys.readouterr()
    assert "violation: joint" in said.out and "nothing was written" in said.err
    assert not file.exists()
    assert main([*export, "--speed", "0.4"]) == 0
    assert main(["deploy", "check", str(file)]) == 0
    facts = read(file).facts
    assert facts["object_mass"] == "volume"
    assert facts["task"] == "dmanus-sim2real" and 0.1 <= facts["variation"]["mass_kg"] <= 0.45
    capsys.readouterr()
    assert main(["deploy", "simulate", str(file), "--boxes", "3"]) == 0
    assert " of 3 (" in capsys.readouterr().out

    assert main(["deploy", "study", str(tmp_path), "--boxes", "3", "--speed", "0.4"]) == 0
    (row,) = json.loads((tmp_path / "playbacks.json").read_text())["runs"].values()
    assert 0 <= row["held"] <= 1 and row["ik_error_m"] < 1e-3
    assert main(["deploy", "study", str(tmp_path), "--task", "cup-pour1"]) == 2
    assert "no run of 'cup-pour1'" in capsys.readouterr().err
