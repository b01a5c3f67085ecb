from __future__ import annotations

import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import pgdm
from command_line import TINY, command, process
from pgdm.cli.console.errors import message
from pgdm.cli.console.progress import ProgressView, duration
from pgdm.cli.console.summary import summary_table
from pgdm.cli.flags import read_flags
from pgdm.config.compose import compose
from pgdm.config.groups import available, groups
from pgdm.config.suites import suites
from pgdm.errors import ConfigError, RunError
from pgdm.experiment import RunResult
from pgdm.rl.callback import Progress
from pgdm.rl.checkpoint import read_checkpoint
from pgdm.rl.evaluate import policy_of
from pgdm.stop import StopRequest
from pgdm.sweep.studies import studies

# The command line itself.


def test_help_names_every_group_and_option() -> None:
    outcome = command("pgdm-run", "--help")
    assert (outcome.code, outcome.err) == (0, "")
    for group in groups():
        assert f"  {group} " in outcome.out.replace("+", "")
        assert all(option in outcome.out for option in available(group))
    for key in ("seed", "total_frames", "num_envs", "num_threads", "run_dir", "resume"):
        assert f"  {key}=" in outcome.out
    for suite in suites():
        assert f"  {suite} " in outcome.out
    for study in studies():
        assert f"  {study} " in outcome.out
    for key in ("sweep.name", "sweep.detach", "sweep.max_attempts", "hydra.launcher.max_jobs"):
        assert f"  {key}=" in outcome.out
    assert "hydra/launcher=local" in outcome.out


def test_without_settings_the_help_is_shown_and_nothing_starts(tmp_path: Path) -> None:
    for arguments in ([], ["--debug"]):
        outcome = command("pgdm-run", *arguments)
        assert outcome.code == 2 and outcome.out.startswith("pgdm-run: train a policy")
    assert list(tmp_path.iterdir()) == []


def test_help_fits_a_terminal_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = command("pgdm-run", "--help").out.splitlines()
    # A name without a space in it cannot be folded.
    assert [line for line in lines if len(line) > 80 and "<hash>" not in line] == []
    assert "such as [module load cuda]" in " ".join(" ".join(lines).split())


def test_help_lists_your_own_settings_too(tmp_path: Path) -> None:
    (tmp_path / "mine" / "task").mkdir(parents=True)
    (tmp_path / "mine" / "task" / "juggle.yaml").touch()
    for folder in ("suite", "sweeps"):
        (tmp_path / "mine" / folder).mkdir()
        (tmp_path / "mine" / folder / f"{folder}_of_mine.yaml").write_text("tasks: [juggle]\n")
    out = command("pgdm-run", "--config-dir", "mine", "--help").out
    assert all(name in out for name in ("juggle", "suite_of_mine", "sweeps_of_mine"))


@pytest.mark.parametrize("name", ["pgdm-run", "pgdm"])
def test_version(name: str) -> None:
    outcome = command(name, "--version")
    assert outcome.code == 0
    assert outcome.out.startswith("pgdm 0.")


@pytest.mark.parametrize("module", ["run", "main"])
def test_help_and_completion_load_nothing_heavy(module: str) -> None:
    code = (
        f"import sys, pgdm.cli.{module}, pgdm.cli.help;"
        "print({'torch', 'mlflow', 'torchrl', 'hydra', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_cfg_prints_and_does_nothing(tmp_path: Path) -> None:
    outcome = process("pgdm-run", "+experiment=quickstart", "seed=5", "--cfg", "job")
    assert outcome.code == 0
    assert "seed: 5\n" in outcome.out
    assert "kind: residual" in outcome.out
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback() -> None:
    outcome = command("pgdm-run", "--debug", "task=hammer-use9")
    assert "Traceback" in outcome.err
    assert len(outcome.errors) == 1


def test_an_error_that_nobody_expected_is_one_line_too() -> None:
    spoil = "import pgdm.cli.help as h; h.help_text = lambda d: 1 / 0"
    outcome = process("pgdm-run", "--help", before=spoil)
    assert outcome.code == 1
    assert outcome.errors == [
        "error: ZeroDivisionError: division by zero (a bug in pgdm: please report it with the "
        "output of --debug)"
    ]
    assert "Traceback" not in outcome.err
    assert "Traceback" in process("pgdm-run", "--help", "--debug", before=spoil).err


def test_output_that_nobody_reads_is_no_error() -> None:
    code = "from pgdm.cli.run import main; import sys; sys.exit(main(['--help']))"
    shell = f'"{sys.executable}" -c "{code}" | true'
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, check=True)
    assert "rror" not in done.stderr


def test_flags_may_stand_anywhere_and_in_short() -> None:
    line = ["seed=1,2", "-m", "-cd", "mine", "--debug", "task=a", "--offline", "-c=all", "-i"]
    flags = read_flags(line)
    assert flags.ours == {"--debug", "--offline"}
    assert flags.hydras == [
        "--multirun", "--config-dir", "mine", "--cfg", "all", "--info", "all",
    ]  # fmt: skip
    assert flags.overrides == ["seed=1,2", "task=a", "offline=true"]
    assert flags.config_dir == "mine"
    assert flags.multirun


words = st.sampled_from(["-m", "--cfg", "job", "--info", "--config-dir", "-h", "--debug", "a=1"])


@given(st.lists(words | st.text(max_size=6), max_size=6))
def test_any_command_line_is_sorted_or_refused(line: list[str]) -> None:
    try:
        flags = read_flags(line)
    except ConfigError as error:
        assert str(error)
    else:
        kept = {*flags.ours, *flags.hydras, *flags.overrides}
        assert {word for word in line if not word.startswith("-")} <= kept


@pytest.mark.parametrize("error", [MemoryError(), KeyboardInterrupt(), OSError(28, "x", "f")])
def test_errors_of_the_machine_name_a_cure(error: BaseException) -> None:
    assert any(word in message(error) for word in ("num_envs", "same command"))


# What is shown.


class FakeTrainer:
    """As much of a trainer as a display looks at."""

    def __init__(self, frames: int, total: int) -> None:
        self.progress = Progress(frames, total, 0, 0.0)


def show(console: Console) -> None:
    view = ProgressView("hammer-use1", console)
    view.on_start(FakeTrainer(0, 3000))  # type: ignore[arg-type]
    metrics = {"train/steps_per_s": 2034.5, "train/success": 0.125, "train/return": 17.25}
    time.sleep(0.01)
    view.on_iteration(Progress(1000, 3000, 1, 0.5), metrics)
    view.on_iteration(Progress(2000, 3000, 2, 1.0), {"train/success": float("nan")})
    evaluated = {"eval_sampled/success": 0.5, "eval_deterministic/success": 0.75}
    evaluated |= {"eval_deterministic/lifted": 0.25, "eval_sampled/lifted": float("nan")}
    view.on_evaluation(Progress(3000, 3000, 3, 1.5), evaluated)
    view.on_end(Progress(3000, 3000, 3, 75.0), "finished")


def test_plain_lines_without_a_terminal() -> None:
    console = Console(file=io.StringIO(), width=60)
    show(console)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines == [
        "1,000/3,000 frames | 2,034 steps/s | success 12.5% | return 17.2 | 0:00 left",
        "evaluation at 3,000 frames: sampled success 50.0%; "
        "deterministic success 75.0%, lifted 25%",
        "finished at 3,000 frames, 1:15",
    ]


def test_one_live_line_on_a_terminal() -> None:
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    show(console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "hammer-use1" in text
    assert "evaluation at 3,000 frames" in text
    assert "\x1b[?25h" in text  # the cursor is back


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3723, "1:02:03")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def table_of(overrides: list[str], frames: int) -> str:
    before = {"eval_sampled/success": 0.01}
    after = {"eval_sampled/success": 0.5, "eval_deterministic/com_error_released": 2e-3}
    result = RunResult("finished", Path(), frames, before, after, None, "planned")
    console = Console(file=io.StringIO(), width=120)
    console.print(summary_table(compose(overrides), result))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_reduced_run_is_never_set_against_the_paper_without_saying_so() -> None:
    text = " ".join(table_of(["+experiment=quickstart"], 524_288).split())
    assert "99.3%" in text  # the paper's
    assert "2.00e-03" in text
    assert "COM error, released [m]" in text
    assert "not comparable with the paper's values: 524,288 of 50,000,000 frames" in text
    for changed in ("action=residual", "algo=sac", "shaping=grasp"):
        assert changed in text


def test_the_papers_settings_are_comparable() -> None:
    text = table_of([], 50_000_000)
    assert "not comparable" not in text
    assert "means of 3 seeds" in text


def test_a_task_that_the_paper_does_not_rate() -> None:
    assert "the paper reports no value" in table_of(["task=dmanus-sim2real"], 100)


# Stopping.


def test_the_first_signal_asks_the_second_ends() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_slurm_sends_several_signals_and_means_one() -> None:
    with StopRequest(patient=True) as stop:
        os.kill(os.getpid(), signal.SIGUSR2)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.exit_code == 140


# Whole runs.


def test_a_run_from_start_to_table_and_on(library_home: Path, tmp_path: Path) -> None:
    first = command("pgdm-run", "--offline", *TINY, "run_dir=run", "seed=3")
    assert (first.code, first.errors) == (0, [])
    assert "hammer-use1 (pgdm, absolute action, ppo, seed 3)" in first.out
    assert "budget 'smoke', not comparable" in " ".join(first.out.split())
    assert "run:    run" in first.out
    assert "32/32 frames" in first.err or "finished at 32 frames" in first.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert (result["status"], result["frames"]) == ("finished", 32)

    again = command("pgdm-run", "--offline", *TINY, "run_dir=run", "seed=3")
    assert again.code == 0
    assert "finished already" in again.err
    assert again.out == first.out
    assert "made with" not in again.err
    path = tmp_path / "run" / "result.json"
    path.write_text(json.dumps({**result, "asset_source": "registry"}))
    other = command("pgdm-run", "--offline", *TINY, "run_dir=run", "seed=3")
    assert "note: it was trained with asset_source 'registry', and the library now has" in other.err

    longer = [*TINY, "run_dir=run", "seed=3", "total_frames=64"]
    grown = command("pgdm-run", "--offline", *longer)
    assert grown.code == 0
    assert "at 32 frames" in grown.err
    assert json.loads((tmp_path / "run" / "result.json").read_text())["frames"] == 64


def test_eval_measures_what_the_run_measured(library_home: Path, tmp_path: Path) -> None:
    run = command(
        "pgdm-run", "--offline", *TINY, "task=duck-lift", "eval.episodes=3", "run_dir=run"
    )
    assert run.code == 0, run.err
    row = next(line for line in run.out.splitlines() if "return" in line).split("│")
    for target in ("run", "run/checkpoints/frames_000000000032.ckpt"):
        outcome = command("pgdm", "eval", target)
        assert outcome.code == 0, outcome.err
        again = next(line for line in outcome.out.splitlines() if "return" in line).split("│")
        assert [cell.strip() for cell in again[2:4]] == [cell.strip() for cell in row[3:5]]
        assert "(32 frames)" in outcome.out


def test_view_films_a_task(library_home: Path, tmp_path: Path) -> None:
    outcome = command("pgdm", "view", "duck-lift", "--video", "out/a.mp4", "--offline")
    if "no OpenGL" in outcome.err:
        pytest.skip(outcome.err)
    assert outcome.code == 0, outcome.err
    assert (tmp_path / "out" / "a.mp4").read_bytes()[4:8] == b"ftyp"
    assert "video:  out/a.mp4" in outcome.out


def test_tasks_lists_all(library_home: Path) -> None:
    outcome = command("pgdm", "tasks")
    assert outcome.code == 0
    assert [line.split()[0] for line in outcome.out.splitlines()[1:]] == available("task")
    assert all(
        line.split()[-1] in ("checkout", "animated") for line in outcome.out.splitlines()[1:]
    )
    assert len(command("pgdm", "tasks", "--tcdm30").out.splitlines()) == 31


def test_tasks_says_what_is_missing() -> None:
    assert (
        "not in the asset library (pgdm assets --help): 51 of 58 tasks"
        in command("pgdm", "tasks").out
    )


def test_multirun_goes_on_after_a_failure_and_tells(library_home: Path, tmp_path: Path) -> None:
    (tmp_path / "run1").write_text("in the way")
    line = ["--offline", "-m", *TINY, "seed=0,1,2", "run_dir=run${seed}"]
    outcome = command("pgdm-run", *line)
    assert outcome.code == 1
    assert "run1' is a file" in outcome.err  # the end of the job's log
    assert "2 finished, 1 failed" in outcome.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run0", "run1", "run2", "runs"]
    for name in ("run0", "run2"):
        assert json.loads((tmp_path / name / "result.json").read_text())["status"] == "finished"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_the_same_command_goes_on(
    library_home: Path, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    line = ["--offline", *TINY, "run_dir=run", "eval.interval_frames=0"]
    start = "import sys; from pgdm.cli.run import main; sys.exit(main())"
    long = [sys.executable, "-c", start, *line, "total_frames=10_000_000"]
    with subprocess.Popen(long, stderr=subprocess.PIPE, text=True) as training:
        deadline = time.monotonic() + 120
        metrics = tmp_path / "run" / "metrics.jsonl"
        while not metrics.exists() or metrics.read_text().count("train") < 2:
            assert training.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        training.send_signal(number)
        _, err = training.communicate(timeout=60)
    assert training.returncode == code
    assert "the same command resumes the run" in err
    assert "Traceback" not in err
    done = json.loads((tmp_path / "run" / "result.json").read_text())
    assert done["status"] == "interrupted"
    assert list((tmp_path / "run" / "checkpoints").glob("frames_*.ckpt"))

    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace("10000000", "32"))  # so that it may end soon
    on = command("pgdm-run", *line, f"total_frames={done['frames'] + 16}")
    assert on.code == 0, on.err
    assert f"at {done['frames']:,} frames" in on.err


def test_settings_are_plain_data() -> None:
    assert json.loads(json.dumps(dataclasses.asdict(compose())))["task"]["id"] == "hammer-use1"


def test_a_signal_that_ends_a_fetch_shows_in_the_exit_code(
    library_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted_fetch(*_args: object, progress: Callable[[str, int, int], None]) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        progress("a download", 1, 2)

    monkeypatch.setattr("pgdm.experiment.ensure", interrupted_fetch)
    outcome = command("pgdm-run", *TINY, "run_dir=run")
    assert outcome.code == 143
    assert "resumes a run from its last checkpoint" in outcome.err
    assert "Traceback" not in outcome.err


def test_a_run_is_resumed_by_its_folder(library_home: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=runs/a").code == 0
    on = command("pgdm", "resume", "a", "--total-frames", "64")
    assert on.code == 0, on.err
    assert f"resuming {Path('runs/a').absolute()} at 32 frames" in on.err
    assert json.loads(Path("runs/a/result.json").read_text())["frames"] == 64
    assert "is finished already" in command("pgdm", "resume", "runs/a").err
    shorter = command("pgdm", "resume", "runs/a", "--total-frames", "32")
    assert shorter.code == 1 and "it may only grow" in shorter.err
    assert "total_frames is 0" in command("pgdm", "resume", "a", "--total-frames", "0").err


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of MLflow's own code
def test_resume_writes_to_no_store_that_a_folder_names(library_home: Path, tmp_path: Path) -> None:
    theirs = f"sqlite:///{tmp_path}/theirs/mlflow.db"
    (tmp_path / "theirs").mkdir()
    made = command("pgdm-run", "--offline", *TINY, "run_dir=runs/a", "tracking.kind=mlflow")
    assert made.code == 0, made.err
    file = Path("runs/a/config.yaml")
    file.write_text(file.read_text().replace("uri: null", f"uri: {theirs}"))
    on = command("pgdm", "resume", "runs/a", "--total-frames", "64", "--offline")
    assert on.code == 0 and f"add --uri {theirs} to mirror the run" in " ".join(on.err.split())
    assert not any((tmp_path / "theirs").iterdir())
    on = command("pgdm", "resume", "runs/a", "--total-frames", "96", "--offline", "--uri", theirs)
    assert on.code == 0 and (tmp_path / "theirs" / "mlflow.db").is_file()


def test_the_policy_of_a_run_acts_on_batches(library_home: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=runs/a").code == 0
    policy = pgdm.load_policy("a")
    env = pgdm.make_batch("hammer-use1", num_envs=3, num_threads=1, offline=True)
    obs = env.reset()
    action = policy.act(obs)
    assert isinstance(action, torch.Tensor) and action.shape == (3, env.action_dim)
    assert policy.frames == 32 and (policy.obs_dim, policy.action_dim) == (obs.shape[1], 30)
    model = policy_of(read_checkpoint(policy.checkpoint), policy.checkpoint)
    best = pgdm.load_policy("a/checkpoints/best.ckpt")  # as listed, below the folder of runs
    assert best.checkpoint == policy.checkpoint.with_name("best.ckpt")
    assert torch.equal(action, model.act(obs, deterministic=True))
    rows = policy.act(obs.numpy())
    assert isinstance(rows, np.ndarray) and np.array_equal(rows, action.numpy())
    assert np.array_equal(policy.act(obs[0].numpy()), policy.act(obs[:1].numpy())[0])
    noisy, again = (pgdm.load_policy("runs/a", seed=1).act(obs, False) for _ in range(2))
    assert torch.equal(noisy, again) and not torch.equal(noisy, action)
    assert not torch.equal(policy.act(obs, False), policy.act(obs, False))
    env.step(action)
    with pytest.raises(ConfigError, match=r"shape \(3, 5\), this policy takes \(N, "):
        policy.act(obs[:, :5])
    with pytest.raises(RunError, match="no run folder or checkpoint 'b'"):
        pgdm.load_policy("b")
    with pytest.raises(ConfigError, match="run is None; it must be a run's folder"):
        pgdm.load_policy(None)  # pyright: ignore[reportArgumentType]


def test_a_policy_is_measured_with_another_seed(library_home: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=run").code == 0
    one, again, other = (
        command("pgdm", "eval", "run", "--offline", "--seed", seed).out for seed in ("1", "1", "2")
    )
    assert one == again != other


@pytest.mark.parametrize("which", [(), ("--best",)])
def test_eval_reads_its_checkpoint_once(
    library_home: Path, monkeypatch: pytest.MonkeyPatch, which: tuple[str, ...]
) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=run").code == 0
    states, load = [], torch.load

    def counted(*args: object, **kwargs: object) -> object:
        states.append(load(*args, **kwargs))
        return states[-1]

    monkeypatch.setattr(torch, "load", counted)
    assert command("pgdm", "eval", "run", "--offline", *which).code == 0
    assert [state["frames"] for state in states] == [32]
