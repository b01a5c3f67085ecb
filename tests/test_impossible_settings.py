"""Settings that cannot be: refused in one line before anything is started."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from command_line import TINY, command
from pgdm import memory
from pgdm.errors import ConfigError
from test_bad_input import assert_helps


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("total_frames=1e18", "about 31,709,792 years at the usual 1,000 steps/s"),
        ("total_frames=1e30", "total_frames: 1e+30 is too large; at most 9.223e+18"),
        ("seed=99999999999999999999", "seed: 99999999999999999999 is too large"),
        ("num_threads=1000000000", "num_threads is 1000000000; it must be at most 1024"),
        ("task.timestep_s=10", "task.timestep_s is 10.0; it must be at most 0.02"),
        ("algo.log_std_init=1e6", "algo.log_std_init is 1000000.0; it must be at most 5"),
        ("algo.log_std_init=-1e6", "algo.log_std_init is -1000000.0; it must be at least -20"),
        ("algo.learning_rate=1e300", "algo.learning_rate: 1e+300 is too large"),
        ("method.reward.tracking_weight=1e300", "tracking_weight: 1e+300 is too large"),
        ("sim.noslip_iterations=100000000000", "it must be at most 10000"),
        ("sim.solver_iterations=1000000000", "it must be at most 10000"),
        ("algo.epochs=1000000000000", "algo.epochs is 1000000000000; it must be at most 10000"),
        ("action.lead_steps=1000000000000", "it must be at most 10000"),
        ("algo.minibatch_size=999999999999", "does not divide"),
    ],
)
def test_settings_out_of_range(tmp_path: Path, setting: str, said: str) -> None:
    assert_helps(command("pgdm-run", *TINY, "run_dir=run", setting), said, code=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["num_envs=1000000"], "num_envs=1000000: this takes at least"),
        (["num_envs=1000000000000000000"], "num_envs=1000000000000000000: this takes"),
        (["eval.episodes=1000000000"], "eval.episodes=1000000000: this takes"),
        (["algo.hidden=[1000000,1000000]"], "algo.hidden=[1000000, 1000000]"),
        (["algo.hidden=[1,10000000000]"], "algo.hidden=[1, 10000000000]"),
        (["algo.steps_per_env=1000000000000"], "algo.steps_per_env=1000000000000"),
        (["num_envs=1000000", "--dry-run"], "num_envs=1000000: this takes at least"),
    ],
)
def test_more_than_the_memory(
    library_home: Path,
    settings: list[str],
    said: str,
) -> None:
    outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run", *settings)
    assert_helps(outcome, said, "GB of memory", "GB are free", "smaller", code=2)
    assert not Path("run", "config.yaml").exists()


def test_evaluating_more_episodes_than_fit(library_home: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=run").code == 0
    outcome = command("pgdm", "eval", "run", "--offline", "--episodes", "1000000000")
    assert_helps(outcome, "eval.episodes=1000000000: this takes", code=2)


def test_a_time_limit_allows_any_length(library_home: Path) -> None:
    endless = [*TINY, "total_frames=1e18", "time_limit_min=1e-6", "run_dir=run"]
    outcome = command("pgdm-run", "--offline", *endless)
    assert outcome.code == 0, outcome.err
    assert "the training takes about 11,574,074,074 days" in outcome.err


def test_a_replay_larger_than_any_disk(library_home: Path) -> None:
    settings = ["algo=sac", "total_frames=1e15", "time_limit_min=1", "run_dir=run", "num_envs=2"]
    outcome = command("pgdm-run", "--offline", *settings, "tracking=none")
    assert_helps(outcome, "cannot reserve", "No space left on device; make room", code=1)


def test_free_memory_follows_the_limits_of_process_and_container(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = memory.free_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 500_000_000, hard))
    try:
        assert memory.free_bytes() < min(600_000_000, before)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    (tmp_path / "max").write_text("max\n")
    (tmp_path / "limit").write_text("1000000\n")
    monkeypatch.setattr(memory, "_CONTAINER", (tmp_path / "max", tmp_path / "limit"))
    assert memory.free_bytes() == 1_000_000
    with pytest.raises(ConfigError, match=r"x=3: this takes at least 0\.0 GB .*; use fewer"):
        memory.check_fits("x=3", 1_000_001, "use fewer")
    memory.check_fits("x=3", 1_000_000, "use fewer")
