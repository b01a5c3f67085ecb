"""What ``make run`` promises: the program learns to grasp, lift and carry an object."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from command_line import process


@pytest.mark.slow
def test_the_quickstart_learns_to_lift(library_home: Path, tmp_path: Path) -> None:
    # The sphere, since every seed lifts it after 50,000 frames, with bfloat16 and without; the
    # hammer after 100,000 on most seeds only. No time limit, so that a slow machine learns as much.
    outcome = process(
        "pgdm-run",
        "+experiment=quickstart",
        "task=spheremedium-lift",
        "total_frames=50_000",
        "time_limit_min=null",
        "--offline",
        "run_dir=run",
        timeout_s=2400,
    )
    assert outcome.code == 0, outcome.err
    run = tmp_path / "run"
    result = json.loads((run / "result.json").read_text())
    reached = result["metrics"]
    # Well below what was measured (97%, 0.4 cm, 303), since a run depends on the processor's
    # rounding; sampled, since all episodes of the mean action are the same.
    assert reached["eval_sampled/lifted"] >= 0.7  # 0.03 before training
    assert reached["eval_sampled/com_error"] <= 0.03  # m, 0.058 before training
    assert reached["eval_sampled/return"] >= 150  # 53 before training
    assert (run / result["video"]).stat().st_size > 10_000
