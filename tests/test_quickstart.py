"""What ``make run`` promises: the hammer is grasped, lifted and carried along its motion."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from command_line import process


@pytest.mark.slow
def test_the_quickstart_learns_to_swing_the_hammer(library_home: Path, tmp_path: Path) -> None:
    # A third of its length: enough to see it learn, and the same program, without its limit of
    # time, so that a slow machine learns as much.
    outcome = process(
        "pgdm-run",
        "+experiment=quickstart",
        "total_frames=100_000",
        "time_limit_min=null",
        "--offline",
        "run_dir=run",
        timeout_s=2400,
    )
    assert outcome.code == 0, outcome.err
    run = tmp_path / "run"
    result = json.loads((run / "result.json").read_text())
    reached = result["metrics"]
    # Well below what was measured (97%, 2 cm, 519), since a run depends on the processor's
    # rounding; sampled, since all episodes of the mean action are the same.
    assert reached["eval_sampled/lifted"] >= 0.7
    assert reached["eval_sampled/com_error"] <= 0.08  # m, 0.19 before training
    assert reached["eval_sampled/return"] >= 250  # 17 before training
    assert (run / result["video"]).stat().st_size > 10_000
