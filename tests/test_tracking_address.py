"""Addresses of MLflow stores: made absolute at the start, refused if MLflow refuses them."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import TINY, command
from fake_runs import empty_database, end, make, train
from pgdm.errors import ConfigError, TrackingError
from pgdm.runs.config_file import read_config, write_config
from pgdm.runs.files import LINK, read_json
from pgdm.tracking import TrackingCfg, located
from pgdm.tracking.address import VARIABLE, absolute, chosen
from pgdm.tracking.mlflow import one_line_errors
from pgdm.tracking.sync import Synced, sync

__all__ = ["empty_database"]  # a fixture

pytestmark = pytest.mark.filterwarnings("ignore")

MIRRORED = tuple(setting for setting in TINY if setting != "tracking=none")
REFUSED = (
    *("./mlruns", "mlruns", "~/mlruns", "/data/mlruns", "file:./mlruns", "file:///data/mlruns"),
    *("file:", "sqlite:", "sqlite://", "sqlite:///", "sqlite:///:memory:", "sqlite:rel.db"),
    *("sqlite:////", "htp://server", "http://", "http:/server", "http://exa mple", "http://[::1"),
    *("http://server:99999", "postgres://u@host/db", "mysql+nosuch://u@host/db", "uc:server"),
    *("databricks-uc", "ftp://server/x", "server:5000", "postgresql+psycopg://u@host:port/db"),
)


@pytest.mark.parametrize(
    ("uri", "found"),
    [
        ("sqlite:///rel.db", "sqlite:///{here}/rel.db"),
        ("sqlite:///sub/../rel.db", "sqlite:///{here}/rel.db"),
        ("SQLITE:///rel.db?timeout=3", "sqlite:///{here}/rel.db?timeout=3"),
        ("sqlite+pysqlite:///rel.db", "sqlite:///{here}/rel.db"),
        ("sqlite:///~/rel.db", "sqlite:///{here}/home/rel.db"),
        ("sqlite:////data/x.db", "sqlite:////data/x.db"),
        (" http://server:5000 ", "http://server:5000"),
        ("HTTPS://u:p@server/mlflow/", "https://u:p@server/mlflow/"),
        ("databricks", "databricks"),
        ("databricks://profile", "databricks://profile"),
    ],
)
def test_an_address_is_absolute(
    uri: str, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    expected = found.format(here=tmp_path)
    assert absolute(uri, "tracking.uri") == absolute(expected, "tracking.uri") == expected


@pytest.mark.parametrize("uri", REFUSED)
def test_what_mlflow_refuses_is_refused(uri: str) -> None:
    with pytest.raises(ConfigError, match=r"--uri is '.*valid: http://HOST:PORT") as error:
        absolute(uri, "--uri")
    assert "\n" not in str(error.value)


def test_mlflows_switch_for_folders_is_obeyed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    for uri in ("./mlruns", "file:mlruns", f"file://{tmp_path}/mlruns"):
        assert absolute(uri, "tracking.uri") == (tmp_path / "mlruns").as_uri()


def test_the_environment_counts_where_nothing_else_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    assert located(TrackingCfg("mlflow", None, "e"), said.append).uri is None
    monkeypatch.setenv(VARIABLE, "http://me:secret@server:5000")
    assert chosen("sqlite:////a.db", "--uri", said.append) == "sqlite:////a.db"
    assert located(TrackingCfg("none", None, "e"), said.append).uri is None
    assert said == []
    found = located(TrackingCfg("mlflow", None, "e"), said.append)
    assert found.uri == "http://me:secret@server:5000"
    assert VARIABLE in said[0] and "tracking.uri" in said[0] and "secret" not in said[0]
    monkeypatch.setenv(VARIABLE, "./mlruns")
    with pytest.raises(ConfigError, match=f"{VARIABLE} is './mlruns'.*sqlite:///{tmp_path}"):
        located(TrackingCfg("mlflow", None, "e"), said.append)


@pytest.mark.parametrize("many", [(), ("--dry-run",), ("-m", "seed=0,1")])
def test_a_run_is_refused_before_its_first_frame(
    many: tuple[str, ...], library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = command("pgdm-run", *MIRRORED, "tracking.uri=./mlruns", *many)
    assert outcome.code == 2 and len(outcome.errors) == 1, outcome.err
    assert "tracking.uri is './mlruns'" in outcome.errors[0]
    monkeypatch.setenv(VARIABLE, "file:///data/mlruns")
    outcome = command("pgdm-run", *MIRRORED, *many)
    assert outcome.code == 2 and VARIABLE in outcome.errors[0], outcome.err
    assert not (tmp_path / "runs").exists()


def test_a_run_keeps_the_absolute_address(
    library_home: Path, tmp_path: Path, empty_database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here.db").write_bytes(empty_database.read_bytes())
    monkeypatch.setenv(VARIABLE, "sqlite:///here.db")
    outcome = command("pgdm-run", "--offline", *MIRRORED, "run_dir=run")
    assert outcome.code == 0 and f"{VARIABLE} is set" in outcome.err, outcome.err
    here = f"sqlite:///{tmp_path}/here.db"
    assert read_config(tmp_path / "run")["tracking"]["uri"] == here
    assert read_json(tmp_path / "run" / LINK)["uri"] == here
    monkeypatch.delenv(VARIABLE)
    monkeypatch.chdir(tmp_path.parent)
    synced = command("pgdm", "runs", "sync", str(tmp_path), "--uri", here)
    assert synced.out.startswith("unchanged")


def test_a_sweep_keeps_the_absolute_address(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "sqlite:///here.db")
    asked = ("-m", "seed=0,1", "sweep.name=two", "sweep.dry_run=true")
    outcome = command("pgdm-run", "--offline", *MIRRORED, *asked)
    assert outcome.code == 0 and outcome.err.count(f"{VARIABLE} is set") == 1, outcome.err


def test_the_stores_that_runs_name_are_not_written_to(tmp_path: Path, empty_database: Path) -> None:
    root = tmp_path / "runs"
    bad = ["./mlruns", "http://127.0.0.1:9", "http://127.0.0.1:9", "mysql+nosuch://u@h/x", None]
    for number, uri in enumerate(bad):
        folder = make(root / f"r{number}", number)
        train(folder)
        end(folder)
        settings = {**read_config(folder.path), "tracking": {"uri": uri, "experiment": "pgdm"}}
        write_config(folder.path, settings)
    (root / "mlflow.db").write_bytes(empty_database.read_bytes())
    done: list[Synced] = []
    sync(root, notify=done.append)
    assert [one.action for one in done] == ["created"] * 5
    with pytest.raises(TrackingError, match="5 of 5 runs could not be synced"):
        sync(root, "http://127.0.0.1:9", done.append)
    assert [one.action for one in done[5:]] == ["failed"] * 5
    assert all("\n" not in one.reason for one in done)
    for name, uri in (("runs", "./mlruns"), ("dashboard", "htp://x"), ("report", "file:x")):
        arguments = {"runs": ("sync", str(root)), "report": ("pgdm",)}.get(name, (str(root),))
        refused = command("pgdm", name, *arguments, "--uri", uri)
        assert refused.code == 2 and f"--uri is '{uri}'" in refused.errors[0]


@pytest.mark.parametrize("error", [ValueError("a\nb"), ImportError("a"), OSError("a")])
def test_every_failure_of_a_store_is_one_line(error: Exception) -> None:
    with pytest.raises(TrackingError, match=r"^here: a$"), one_line_errors("here"):
        raise error
