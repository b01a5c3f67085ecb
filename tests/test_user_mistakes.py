"""Mistakes in a user's own code, machine and files: one line that helps, never "a bug in pgdm"."""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgdm
from command_line import TINY, command, process
from pgdm import files
from pgdm.cli.console import errors
from pgdm.config.compose import compose
from pgdm.errors import CheckpointError, ConfigError, CorruptAssetError
from pgdm.pregrasp.predict import weights
from pgdm.rl import checkpoint
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint, write_checkpoint
from test_bad_input import assert_helps

METHOD = """
from dataclasses import replace
from pgdm.mdp.recipe import EndTerm, RewardTerm
from pgdm.methods import Method, MethodCfg
from pgdm.methods.pgdm import recipe as base

def extended(cfg):
    r = base(cfg)
    {body}

MINE = Method({config}, {recipe})
"""


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("def x(:\n", "mistaken.py, line 1: invalid syntax"),
        ("x = 1\0\n", "mistaken: source code string cannot contain null bytes"),
        ("raise SystemExit(7)\n", "importing 'mistaken' ends Python (exit code 7)"),
        (
            METHOD.format(
                body="return replace(r, rewards=(RewardTerm('a', 1.0, lambda c: 1.0),))",
                config="MethodCfg",
                recipe="extended",
            ),
            "the reward 'a' of this method returns a float; it must be a tensor",
        ),
        (
            METHOD.format(
                body="return replace(r, ends=(EndTerm('b', lambda c: c.object_error),))",
                config="MethodCfg",
                recipe="extended",
            ),
            "the termination 'b' of this method returns torch.float64; it must be torch.bool",
        ),
        (
            METHOD.format(
                body="return replace(r, rewards=(RewardTerm('a', 'heavy', lambda c: c.t),))",
                config="MethodCfg",
                recipe="extended",
            ),
            "the weight of the reward 'a' is 'heavy'; it must be a finite number",
        ),
        (
            METHOD.format(
                body="return replace(r, rewards=['a'])", config="MethodCfg", recipe="extended"
            ),
            "a recipe has 'a' where a RewardTerm is needed",
        ),
        (
            METHOD.format(
                body="return replace(r, rewards=())", config="MethodCfg", recipe="extended"
            ),
            "a recipe needs at least one reward and one termination",
        ),
        (
            METHOD.format(
                body="return replace(r, rewards=(RewardTerm('a', 1.0, lambda c, d: c.t),))",
                config="MethodCfg",
                recipe="extended",
            ),
            "the reward 'a' of this method cannot be called with a StepContext alone",
        ),
        (
            METHOD.format(body="pass", config="MethodCfg", recipe="extended"),
            "its recipe function returns None; it must return a pgdm.mdp.recipe.Recipe",
        ),
        (
            METHOD.format(body="raise SystemExit(3)", config="MethodCfg", recipe="extended"),
            "its recipe function ends Python (exit code 3)",
        ),
        (
            METHOD.format(body="pass", config="dict", recipe="extended"),
            "config of the Method is <class 'dict'>; it must be a frozen dataclass",
        ),
    ],
)
def test_mistakes_in_a_method(
    library_home: Path, monkeypatch: pytest.MonkeyPatch, source: str, said: str
) -> None:
    Path("mistaken.py").write_text(source)
    monkeypatch.syspath_prepend(str(Path.cwd()))
    monkeypatch.delitem(sys.modules, "mistaken", raising=False)
    arguments = ["--offline", *TINY, "method.name=mistaken:MINE", "run_dir=run"]
    assert_helps(command("pgdm-run", *arguments), said, code=2)


@pytest.mark.parametrize("files", [{"a": "a"}, {"a": "b", "b": "a"}])
def test_settings_that_include_themselves(files: dict[str, str]) -> None:
    folder = Path("mine", "experiment")
    folder.mkdir(parents=True)
    for name, included in files.items():
        (folder / f"{name}.yaml").write_text(f"defaults:\n  - {included}\nseed: 1\n")
    outcome = command("pgdm-run", "--config-dir", "mine", *TINY, "+experiment=a")
    assert_helps(outcome, "refers to itself, from ", "+experiment=a: check the defaults", code=2)


# The machine.


def without_home(code: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run Python as a user without a home, as in containers."""
    lacking = ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "PGDM_USER_DIR", "PGDM_HOME")
    kept = {name: value for name, value in os.environ.items() if name not in lacking}
    before = "import os, pwd; pwd.getpwuid = lambda uid: {}[uid];"
    return subprocess.run(
        [sys.executable, "-c", f"{before} {code}"],
        capture_output=True,
        text=True,
        env=kept | env,
        check=False,
    )


def test_a_user_without_a_home() -> None:
    done = without_home("import sys; from pgdm.cli.main import main; sys.exit(main(['tasks']))")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "error: ~/.cache: no home folder is known for '~'; set HOME or PGDM_HOME" in done.stderr
    given = {"PGDM_USER_DIR": "user", "PGDM_HOME": "home"}
    code = "import sys; from pgdm.cli.main import main; sys.exit(main(['tasks']))"
    assert without_home(code, **given).returncode == 0


@pytest.mark.parametrize("variable", ["PGDM_USER_DIR", "PGDM_HOME"])
def test_the_home_of_an_unknown_user(variable: str) -> None:
    outcome = process("pgdm", "tasks", env={variable: "~nosuchuser/x"})
    assert_helps(outcome, f"{variable}=~nosuchuser/x", "no home folder", code=2)
    assert "Traceback" not in outcome.err


def test_closed_standard_streams() -> None:
    code = "import sys; from pgdm.cli.main import main; sys.exit(main(['tasks']))"
    for closed in (">&-", "2>&-", ">&- 2>&-"):
        done = subprocess.run(
            ["bash", "-c", f'"{sys.executable}" -c "{code}" {closed}'],
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_python_without_docstrings(library_home: Path) -> None:
    code = "import sys; from pgdm.cli.run import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-OO", "-c", code, "--offline", *TINY, "run_dir=run"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "because Python runs with -OO" in done.stderr
    assert "Traceback" not in done.stderr


def test_warnings_as_errors_are_for_developers(library_home: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=runs/a").code == 0
    outcome = process("pgdm", "runs", "sync", env={"PYTHONWARNINGS": "error"})
    assert (outcome.code, outcome.errors) == (0, []), outcome.err
    assert "1 created" in outcome.out


def test_a_clock_that_stands_still(library_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
    assert (outcome.code, outcome.errors) == (0, []), outcome.err


def test_a_full_disk_in_a_sweep() -> None:
    error = OSError(28, "No space left on device", "runs/sweeps/x/plan.json")
    assert "the disk is full; make room" in errors.message(error)


# Python.


def test_environments_that_cannot_be(library_home: Path) -> None:
    wrong: dict[Any, str] = {0: "num_envs is 0; it must be at least 1", 10**18: "GB of memory"}
    for number in (2.0, "2", None, True, float("nan")):
        wrong[number] = f"num_envs is {number!r}; it must be a whole number, 1 or more"
    for number, said in wrong.items():
        with pytest.raises(ConfigError, match=said):
            pgdm.make_batch("hammer-use1", num_envs=number, offline=True)
    with pytest.raises(ConfigError, match="num_threads is -1; it must be at least 0"):
        pgdm.make_batch("hammer-use1", num_threads=-1, offline=True)


def test_actions_of_numpy_and_of_a_wrong_shape(library_home: Path) -> None:
    env = pgdm.make_batch("hammer-use1", num_envs=2, num_threads=1, offline=True)
    other = pgdm.make_batch("hammer-use1", num_envs=2, num_threads=1, offline=True)
    action = np.full((2, env.action_dim), 0.1, np.float32)
    assert torch.equal(env.step(action)[0], other.step(torch.from_numpy(action))[0])  # type: ignore
    with pytest.raises(ConfigError, match=r"shape \(30,\); it must be .* \(2, 30\)"):
        env.step(torch.zeros(env.action_dim))
    nothing: Any
    for nothing in (None, "x", np.full((2, 30), "x")):
        with pytest.raises(ConfigError, match="the actions are not an array of numbers"):
            env.step(nothing)


def test_a_graphics_variable_does_not_stop_python(library_home: Path) -> None:
    code = "import pgdm; pgdm.make_batch('hammer-use1', num_envs=1, offline=True).reset()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"MUJOCO_GL": "weird"},
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("overrides", ["seed=1", [None], [3]])
def test_overrides_that_are_no_list_of_texts(overrides: Any) -> None:
    with pytest.raises(ConfigError, match="give a list of strings such as 'seed=3'"):
        compose(overrides)


# Checkpoints and predictors.


@pytest.fixture
def trained(library_home: Path) -> Path:
    """Return the checkpoints of a run of two iterations."""
    arguments = ["--offline", *TINY, "run_dir=run", "checkpoint.interval_s=1e-9"]
    assert command("pgdm-run", *arguments).code == 0
    assert len(CheckpointFolder(Path("run", "checkpoints"), 9).all()) > 1
    return Path("run", "checkpoints")


def signed(payload: bytes) -> bytes:
    """Return a payload with the checksum of a checkpoint."""
    return payload + checkpoint._MAGIC + hashlib.sha256(payload).digest()


FORGED: dict[str, Callable[[dict[str, Any]], Any]] = {
    "nothing": lambda state: {},
    "no learner": lambda state: {k: v for k, v in state.items() if k != "learner"},
    "frames": lambda state: state | {"frames": "many"},
    "empty learner": lambda state: state | {"learner": {}},
    "empty collector": lambda state: state | {"collector": {}},
    "list": lambda state: [state],
    "tensors": lambda state: (
        state | {"learner": {name: torch.zeros(1) for name in state["learner"]}}
    ),
    "rows": lambda state: state | {"collector": dict.fromkeys(state["collector"], torch.zeros(1))},
}


@pytest.mark.filterwarnings("default")  # torch warns of what is in the file
@pytest.mark.parametrize("forge", FORGED.values(), ids=FORGED)
def test_a_forged_checkpoint_gives_way_to_the_one_before(
    trained: Path, caplog: pytest.LogCaptureFixture, forge: Callable[[dict[str, Any]], Any]
) -> None:
    newest = CheckpointFolder(trained, 9).all()[-1]
    write_checkpoint(newest, forge(read_checkpoint(newest)))
    with caplog.at_level(logging.WARNING):
        longer = [*TINY, "run_dir=run", "total_frames=64", "checkpoint.interval_s=1e-9"]
        outcome = command("pgdm-run", "--offline", *longer)
    assert (outcome.code, outcome.errors) == (0, []), outcome.err
    assert "trying the checkpoint before it" in caplog.text + outcome.err
    evaluated = command("pgdm", "eval", "run", "--offline")
    assert evaluated.code == 0, evaluated.err


def test_what_is_signed_but_no_tensors(trained: Path) -> None:
    good = trained / "best.ckpt"
    payload = good.read_bytes()[: -checkpoint._FOOTER_SIZE]
    generator = np.random.default_rng(0)
    texts = [b"", b"garbage", pickle.dumps({"a": 1}), b"PK\x03\x04" + bytes(100), payload[:-50]]
    for _ in range(60):
        mutated = bytearray(payload)
        for place in generator.integers(0, len(payload), 20):
            mutated[place] = generator.integers(256)
        texts.append(bytes(mutated))
    refused = 0
    for text in texts:
        good.write_bytes(signed(text))
        try:
            read_checkpoint(good)
        except CheckpointError as error:
            refused += 1
            assert "weights_only" not in str(error)
            assert "\n" not in str(error)
    assert refused >= 5


@pytest.mark.parametrize("content", [b"", b"garbage", b"\x80\x02c__main__\nX\n."])
def test_a_garbage_predictor(content: bytes) -> None:
    path = weights.path_of("adroit")
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    with pytest.raises(CorruptAssetError, match="pgdm pregrasp train --hand adroit") as refused:
        weights.read(path, "adroit")
    assert "weights_only" not in str(refused.value)


def test_what_a_file_of_tensors_holds_is_named() -> None:
    with pytest.raises(ValueError, match="it is damaged"):
        files.parse_tensors(b"garbage")


# One bad item among good ones.


def conf(name: str, text: str | None) -> Path:
    """Write a file of the user's own settings; None makes a link that leads nowhere."""
    path = Path(os.environ["PGDM_USER_DIR"], "conf", name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text) if text is not None else path.symlink_to("/nowhere/x.yaml")
    return path


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("task/my task.yaml", "id: x\n", "its name 'my task' is not valid"),
        ("task/x.yaml", None, "a link that leads nowhere"),
        ("task/broken.yaml", "id: [\n", "not valid YAML"),
        ("task/list.yaml", "- 1\n", ""),
    ],
)
def test_a_bad_task_file_is_listed_and_blocks_nothing(
    library_home: Path, name: str, text: str | None, reason: str
) -> None:
    file = conf(name, text)
    listing = process("pgdm", "tasks")  # its own process: `import pgdm` registers the tasks
    assert listing.code == 0, listing.err
    assert "hammer-use1" in listing.out
    if reason:
        assert f"unreadable: {file}: {reason}" in listing.out.replace("\n", " ")
    help_ = command("pgdm-run", "--help")
    assert help_.code == 0, help_.err
    run = command("pgdm-run", "--offline", *TINY, "run_dir=run", "--dry-run")
    assert run.code == 0, run.err


@pytest.mark.parametrize("text", ["tasks: [gone]\n", "tasks: [\n", "- 1\n", None])
def test_a_bad_suite_does_not_block_the_help(text: str | None) -> None:
    conf("suite/mine.yaml", text)
    outcome = command("pgdm-run", "--help")
    assert outcome.code == 0, outcome.err
    assert "tcdm30" in outcome.out
    assert "mine" in outcome.out
    assert "cannot be read" in outcome.out


def test_a_damaged_manifest_of_ones_own(library_home: Path) -> None:
    folder = Path(os.environ["PGDM_USER_DIR"], "library")
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text('{"files": null}')
    outcome = process("pgdm", "tasks")
    assert outcome.code == 0, outcome.err
    assert "hammer-use1" in outcome.out
    assert "continuing without your own objects" in outcome.err
    assert "'pgdm author'" in outcome.err


RESULTS = {
    "metrics": '{"status": "finished", "metrics": null}',
    "a metric": '{"status": "finished", "metrics": {"eval_sampled/success": "high"}}',
    "versions": '{"status": "finished", "versions": null}',
    "frames": '{"status": "finished", "frames": null}',
}


@pytest.mark.parametrize("text", RESULTS.values(), ids=RESULTS)
def test_a_result_of_wrong_types_is_listed_and_written_again(trained: Path, text: str) -> None:
    shutil.copytree("run", "runs/bad")
    shutil.copytree("run", "runs/good")
    Path("runs", "bad", "result.json").write_text(text)
    listed = command("pgdm", "runs", "--json")
    assert listed.code == 0, listed.err
    assert '"unreadable"' in listed.out
    assert '"finished"' in listed.out
    assert "result.json: it is damaged" in listed.out
    reported = command("pgdm", "report", "runs")
    assert reported.code == 0, reported.err
    again = command("pgdm-run", "--offline", *TINY, "run_dir=runs/bad")
    assert again.code == 0, again.err
    assert '"unreadable"' not in command("pgdm", "runs", "--json").out


@pytest.mark.filterwarnings("ignore")  # of MLflow's libraries
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.yaml", "seed: null\n"),
        ("config.yaml", "seed: [1]\ntask: {id: 3}\n"),
        ("config.yaml", "a: &a [*a]\n"),
        ("config.yaml", "metrics: [1]\n"),
        ("metrics.jsonl", '{"frames": ' + "9" * 400 + ', "kind": "eval"}\n'),
        ("metrics.jsonl", "[" * 200_000 + "\n"),
        ("metrics.jsonl", '{"frames": 1, "kind": 3}\n{"frames": 2, "kind": ["eval"]}\n'),
        ("mlflow.json", '{"attempts": "x", "parent": [], "run_id": 3}'),
    ],
)
def test_a_run_of_wrong_types_blocks_no_listing(trained: Path, name: str, text: str) -> None:
    shutil.copytree("run", "runs/bad")
    shutil.copytree("run", "runs/good")
    Path("runs", "bad", name).write_text(text)
    for arguments in (("runs",), ("runs", "--json"), ("report", "runs"), ("runs", "sync")):
        outcome = command("pgdm", *arguments)
        assert (outcome.code, outcome.errors) == (0, []), outcome.err
        assert "good" in outcome.out or arguments[0] == "report"
