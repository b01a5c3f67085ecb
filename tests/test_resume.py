"""A run that was killed and started again equals one that never stopped, to the bit."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from pgdm.rl.checkpoint import CheckpointFolder
from pgdm.runs.files import read_json
from pgdm.runs.log import RunLog
from test_rl_resume import flat

SMALL = (
    "task=dmanus-sim2real",  # its resets draw random numbers too
    "total_frames=10240",
    "num_envs=8",
    "algo.steps_per_env=32",
    "eval.interval_frames=2048",
    "eval.episodes=3",
    "eval.video=false",
    "checkpoint.interval_s=0.3",
    "tracking=none",
    "seed=7",
    "--offline",
)
FAST = (
    *("+experiment=fast", "algo.batch_size=64", "algo.updates_per_step=1"),
    "total_frames=6144",  # enough for three kills
)
LEARNING = {
    "ppo": ("algo=ppo", "algo.minibatch_size=64"),
    "ppo_fast": ("algo=ppo_fast", "algo.minibatch_size=64"),
    "fast": FAST,
    # The weights of the frames in the replay change until the end.
    "fast, curriculum": (*FAST, "method=curriculum", "method.curriculum.ramp_frames=6144"),
}
TIMED = ("time_s", "train/steps_per_s")


def command(folder: Path, threads: int, algo: str) -> list[str]:
    run = Path(sys.executable).with_name("pgdm-run")
    rest = (*LEARNING[algo], f"num_threads={threads}", f"run_dir={folder}")
    return [str(run), *SMALL, *rest]


def kill_at_random(arguments: list[str], folder: Path, rng: random.Random) -> None:
    """Start the run, let it come some way beyond what it had, and kill it without warning."""
    checkpoints = CheckpointFolder(folder / "checkpoints", 2)
    before = checkpoints.all()
    process = subprocess.Popen(arguments, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    limit = time.monotonic() + 120
    while checkpoints.all() == before and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, 1.0))
    assert process.poll() is None, "the run ended before it could be killed"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return state(folder)["learner"]["model"]


def state(folder: Path) -> dict[str, Any]:
    """Return all that the rest of a training would depend on."""
    found = CheckpointFolder(folder / "checkpoints", 2).latest()
    assert found is not None
    return {name: value for name, value in found.items() if name != "elapsed_s"}


def metrics(folder: Path) -> list[dict]:
    lines = RunLog(folder / "metrics.jsonl").read()
    return [{k: repr(v) for k, v in line.items() if k not in TIMED} for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "algo"), [(1, "ppo"), (2, "ppo_fast"), (2, "fast"), (1, "fast, curriculum")]
)
def test_three_kills_change_nothing(
    threads: int, algo: str, tmp_path: Path, library_home: Path
) -> None:
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    subprocess.run(command(straight, threads, algo), check=True, capture_output=True)
    rng = random.Random(os.getpid())
    for _ in range(3):
        kill_at_random(command(killed, threads, algo), killed, rng)
    subprocess.run(command(killed, threads, algo), check=True, capture_output=True)
    assert metrics(straight) == metrics(killed)
    a, b = state(straight), state(killed)
    assert a.keys() == b.keys()
    assert [name for name in a if flat(a[name]) != flat(b[name])] == []
    results = [read_json(folder / "result.json")["metrics"] for folder in (straight, killed)]
    assert results[0] == results[1]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_the_same_command_goes_on(
    number: signal.Signals, tmp_path: Path, library_home: Path
) -> None:
    folder = tmp_path / "run"
    arguments = [*command(folder, 1, "ppo"), "checkpoint.interval_s=1000"]
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True)
    log = RunLog(folder / "metrics.jsonl")
    while len(log.read()) < 4 and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "the same command resumes" in err
    assert read_json(folder / "result.json")["status"] == "interrupted"
    lines = len(log.read())
    assert CheckpointFolder(folder / "checkpoints", 2).latest()["iteration"] >= 3
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert "resuming" in done.stderr
    assert len(log.read()) > lines
    assert read_json(folder / "result.json")["status"] == "finished"


@pytest.mark.slow
def test_a_finished_run_is_shown_and_a_longer_one_goes_on(
    tmp_path: Path, library_home: Path
) -> None:
    folder = tmp_path / "run"
    arguments = [*command(folder, 1, "ppo"), "total_frames=512"]
    subprocess.run(arguments, check=True, capture_output=True)
    again = subprocess.run(arguments, check=True, capture_output=True, text=True)
    assert "finished already" in again.stderr
    longer = [*arguments[:-1], "total_frames=1024"]
    subprocess.run(longer, check=True, capture_output=True)
    assert read_json(folder / "result.json")["frames"] == 1024
    # The evaluation at the end of the shorter run stays; what is trained is the same.
    straight = tmp_path / "straight"
    whole = [*command(straight, 1, "ppo"), "total_frames=1024"]
    subprocess.run(whole, check=True, capture_output=True)
    a, b = weights(folder), weights(straight)
    assert all(torch.equal(a[name], b[name]) for name in a)
