"""Settings and run folders that somebody else wrote run no code."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import yaml

from command_line import command
from pgdm.config.compose import compose
from pgdm.config.saved import load_config, save_config
from pgdm.errors import ConfigError
from pgdm.methods import METHODS
from pgdm.sweep.studies import open_study

CALLBACK = {"x": {"_target_": "numpy.savetxt", "fname": "pwned", "X": [1]}}
HANDLER = {"handlers": {"x": {"class": "logging.FileHandler", "filename": "pwned"}}}
FILES = {
    "callback": {"hydra": {"callbacks": CALLBACK}},
    "pandas": {
        "hydra": {"callbacks": {"x": {"_target_": "pandas.read_pickle"}}},
    },
    "sweeper": {"hydra": {"sweeper": {"_target_": "pathlib.Path.unlink"}}},
    "launcher": {"hydra": {"launcher": {"_target_": "os.system"}}},
    "job log": {"hydra": {"job_logging": HANDLER}},
    "hydra log": {"hydra": {"hydra_logging": HANDLER}},
    "search path": {"hydra": {"searchpath": ["pkg://evil"]}},
    "elsewhere": {"algo": {"_target_": "os.system"}},
    "in a list": {"hydra": {"callbacks": None}, "extra": [{"deep": {"_target_": "os.system"}}]},
}


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PGDM_USER_DIR", str(tmp_path / "user"))
    monkeypatch.delenv("PGDM_METHODS", raising=False)
    return tmp_path


def refused(*arguments: str, said: str) -> None:
    outcome = command("pgdm-run", *arguments)
    assert outcome.code != 0
    assert len(outcome.errors) == 1 and said in outcome.errors[0], outcome.err
    assert "Traceback" not in outcome.err
    assert not Path("pwned").exists() and not Path("runs").exists()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("flag", ["--dry-run", "--cfg=job"])
def test_an_experiment_file_that_would_run_code(name: str, flag: str) -> None:
    file = Path("my", "experiment", "evil.yaml")
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\n" + yaml.safe_dump(FILES[name]))
    refused("--config-dir=my", "+experiment=evil", flag, said=f"{file.absolute()}: ")


@pytest.mark.parametrize("name", FILES)
def test_the_same_in_the_users_own_folder(name: str, working_folder: Path) -> None:
    file = working_folder / "user" / "conf" / "experiment" / "evil.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\n" + yaml.safe_dump(FILES[name]))
    with pytest.raises(ConfigError, match=f"{file}: .* is refused"):
        compose(["+experiment=evil"])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("+hydra.callbacks.x._target_", "pandas.read_pickle"),
        ("++hydra.callbacks.x", "{_target_: pathlib.Path.unlink}"),
        ("+hydra", "{callbacks: {x: {_target_: numpy.load}}}"),
        ("hydra.sweeper._target_", "os.system"),
        ("hydra/job_logging", "default"),
        ("+hydra.job_logging.handlers.x.class", "logging.FileHandler"),
        ("hydra.searchpath", "[pkg://evil]"),
    ],
)
def test_a_sweep_file_or_a_command_that_would_run_code(key: str, value: str) -> None:
    Path("evil.yaml").write_text(yaml.safe_dump({"task": "cup-pour1", key: value}))
    refused("+sweep=evil.yaml", "--dry-run", said="evil.yaml: ")
    refused("task=cup-pour1", f"{key}={value}", "--dry-run", said="refused")


def test_files_that_move_their_keys_into_hydras_own() -> None:
    for group, package, content in (
        ("a", "hydra.callbacks", {"x": {"fname": "pwned"}}),
        ("b", "hydra.job_logging", HANDLER),
        ("hydra/job_logging", "hydra.job_logging", HANDLER),
    ):
        file = Path("my", group, "evil.yaml")
        file.parent.mkdir(parents=True)
        file.write_text(f"# @package {package}\n" + yaml.safe_dump(content))
        prefix = "" if group.startswith("hydra") else "+"
        refused("--config-dir=my", f"{prefix}{group}=evil", "--dry-run", said="is refused")


def test_shell_commands_before_a_job_must_be_typed() -> None:
    Path("evil.yaml").write_text(
        "task: cup-pour1\nseed: [0, 1]\nhydra/launcher: slurm\n"
        "hydra.launcher.setup: [[touch pwned]]\n"
    )
    refused("+sweep=evil.yaml", "--dry-run", said="hydra.launcher.setup to ['touch pwned']")
    typed = ("hydra.launcher.setup=[module load cuda]", "--dry-run")
    assert command("pgdm-run", "+sweep=evil.yaml", *typed).code == 0


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
        + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)),
        "[" * 100_000,
    ],
    ids=["aliases", "lists"],
)
def test_yaml_without_end_in_every_settings_file(text: str) -> None:
    for name in ("my/experiment/evil.yaml", "my/sweeps/evil.yaml", "my/suite/evil.yaml"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    refused("--config-dir=my", "+experiment=evil", "--dry-run", said="not valid YAML")
    refused("--config-dir=my", "+sweep=evil", "--dry-run", said="not valid YAML")
    refused("--config-dir=my", "-m", "task=evil", "--dry-run", said="not valid YAML")


METHOD = """
from pathlib import Path
from pgdm.methods import METHODS
Path("pwned").touch()
METHOD = METHODS["pgdm"]
"""


@pytest.fixture
def module(working_folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (working_folder / "evil_method.py").write_text(METHOD)
    monkeypatch.syspath_prepend(str(working_folder))
    monkeypatch.delitem(sys.modules, "evil_method", raising=False)
    return "evil_method"


def test_the_module_of_a_foreign_run_is_not_imported(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cfg = compose(["task=cup-pour1"])
    method = dataclasses.replace(cfg.method, name=f"{module}:METHOD")
    save_config(dataclasses.replace(cfg, method=method), "theirs")
    with pytest.raises(ConfigError, match=f"PGDM_METHODS={module}"):
        load_config("theirs")
    outcome = command("pgdm", "eval", "theirs")
    assert outcome.code != 0 and not Path("pwned").exists()
    monkeypatch.setenv("PGDM_METHODS", module)
    assert load_config("theirs").method.name == f"{module}:METHOD"
    assert Path("pwned").exists()


def test_a_file_does_not_choose_a_module_but_the_user_does(module: str) -> None:
    Path("evil.yaml").write_text(f"task: cup-pour1\nmethod.name: '{module}:METHOD'\n")
    refused("+sweep=evil.yaml", "--dry-run", said=f"PGDM_METHODS={module}")
    name = f"method.name={module}:METHOD"
    assert command("pgdm-run", "task=cup-pour1", name, "--dry-run").code == 0
    Path("pwned").unlink()
    del sys.modules[module]
    assert command("pgdm-run", "+sweep=evil.yaml", "--dry-run").code == 0  # run before


def test_typing_one_method_permits_no_other(module: str) -> None:
    for name, text in {
        "experiment/evil": f"# @package _global_\nmethod:\n  name: {module}:METHOD\n",
        "method/mine": f"defaults: [pgdm]\nname: {module}:METHOD\n",
    }.items():
        Path("my", name).parent.mkdir(parents=True)
        Path("my", f"{name}.yaml").write_text(text)
    own = ("--config-dir=my", "task=cup-pour1", "--dry-run")
    refused(*own, "+experiment=evil", "method=pgdm", said=f"PGDM_METHODS={module}")
    assert not Path("pwned").exists()
    assert command("pgdm-run", *own, "method=mine").code == 0
    assert Path("pwned").exists()


def test_sweep_files_of_pgdm_are_not_refused() -> None:
    assert open_study(["+sweep=baselines_tcdm30"])[0] == "baselines_tcdm30"
    assert set(METHODS) == {"pgdm", "deepmimic", "graff", "curriculum", "full"}
