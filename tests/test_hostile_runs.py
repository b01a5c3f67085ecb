"""Run folders, sweeps and MLflow stores that somebody else made: nothing hangs or is written to."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from command_line import command
from fake_runs import LENGTH, STEP, empty_database, end, make, train
from pgdm.config.compose import compose
from pgdm.errors import ConfigError, RunError
from pgdm.library.progress import silent
from pgdm.mdp.recipe import Measure, RewardTerm
from pgdm.methods import recipe
from pgdm.report import source
from pgdm.runs.checkpoints import find_checkpoint
from pgdm.runs.files import LINK, write_json
from pgdm.runs.folder import RunFolder, check_links, find_runs, holds_run
from pgdm.sweep.ledger import FILE, Ledger
from pgdm.sweep.plan import write_plan
from pgdm.sweep.status import PLAN, log_path
from pgdm.tracking.mlflow import Store, is_own, store_uri
from pgdm.tracking.sync import sync
from sweep_plans import plan

__all__ = ["empty_database"]  # a fixture

pytestmark = pytest.mark.filterwarnings("ignore")  # of MLflow's dependencies

PLACES = ("config.yaml", "result.json", "metrics.jsonl", "mlflow.json", "checkpoints/best.ckpt")


@pytest.fixture
def root(tmp_path: Path, empty_database: Path) -> Path:
    runs = tmp_path / "runs"
    runs.mkdir()
    shutil.copy(empty_database, runs / "mlflow.db")
    good = make(runs / "good")
    train(good)
    end(good)
    bad = make(runs / "bad", seed=1)
    train(bad)
    end(bad)
    return runs


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def huge(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(1 << 34)


@pytest.mark.parametrize("kind", [pipe, endless, huge])
def test_pipes_and_devices_in_run_folders(root: Path, kind: Callable[[Path], None]) -> None:
    names = [f"bad{number}" for number in range(len(PLACES))]
    for name, place in zip(names, PLACES, strict=True):
        shutil.copytree(root / "bad", root / name)
        (root / name / place).unlink(missing_ok=True)
        kind(root / name / place)
    start = time.monotonic()
    outcome = command("pgdm", "runs", str(root), "--json")
    rows = {row["run"]: row for row in json.loads(outcome.out)}
    assert set(rows) == {"good", "bad", *names}
    assert rows["good"]["status"] == "finished" and rows["bad0"]["status"] == "unreadable"
    for name in names:
        assert command("pgdm", "eval", str(root / name)).code != 0
    done = {d.folder.path.name: d.action for d in sync(root)}
    assert set(done) == set(rows) and done["good"] == "created"
    assert done["bad0"] == "unreadable"
    assert time.monotonic() - start < 60  # torch, the simulator and MLflow are loaded meanwhile


def test_a_run_does_not_choose_the_store_that_is_written_to(root: Path, tmp_path: Path) -> None:
    for number, uri in enumerate((f"file:{tmp_path}/theirs", "http://127.0.0.1:9", "sqlite:////x")):
        shutil.rmtree(root / "bad")
        make(root / "bad", seed=number, tracking={"uri": uri, "experiment": "../../../x"})
        train(RunFolder(root / "bad"))
        end(RunFolder(root / "bad"))
        assert {done.action for done in sync(root)} <= {"created", "unchanged", "rebuilt"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["runs"]
    client = Store.open(store_uri(root), "pgdm").client
    (odd,) = (e for e in client.search_experiments() if e.name == "../../../x")
    assert odd.artifact_location == (root / "mlflow-artifacts" / "x").as_uri()


def test_only_the_store_of_a_folder_is_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "sweeps" / "x"
    assert is_own(store_uri(tmp_path / "runs"), folder) and is_own(store_uri(folder), folder)
    for uri in (store_uri(tmp_path / "other"), "http://host:5000", "", f"sqlite:///{folder}/a.db"):
        assert not is_own(uri, folder)


def test_a_sweeps_status_tells_no_foreign_store(tmp_path: Path) -> None:
    from pgdm.sweep.mirror import SweepMirror

    link = {"uri": f"file:{tmp_path}/theirs", "experiment": "x", "run_id": "1", "status": "running"}
    (tmp_path / "sweep").mkdir()
    write_json(tmp_path / "sweep" / LINK, link)
    heard: list[str] = []
    SweepMirror.correct_all(tmp_path / "sweep", [], "finished", heard.append)
    assert len(heard) == 1 and "`pgdm runs sync --uri file:" in heard[0]
    assert not (tmp_path / "theirs").exists()


@pytest.mark.parametrize("place", ["checkpoints", "videos", "config.yaml", "videos/x.png"])
def test_links_out_of_a_run_folder(root: Path, tmp_path: Path, place: str) -> None:
    secret = tmp_path / "secret"
    path = root / "bad" / place
    if path.is_dir():
        shutil.move(path, secret)
    elif path.exists():
        path.rename(secret)
    else:
        secret.write_text("secret")
    path.symlink_to(secret)
    with pytest.raises(RunError, match=f"is a link to {secret}, outside of its run folder"):
        check_links(root / "bad")
    with pytest.raises(RunError, match="is a link to"):
        find_checkpoint(root / "bad", best=True)
    with pytest.raises(RunError, match="is a link to"):
        holds_run(root / "bad", "auto")
    done = {d.folder.path.name: d for d in sync(root)}
    assert done["good"].action == "created"
    assert done["bad"].action == "unreadable" and "is a link to" in done["bad"].reason
    copies = (root / "mlflow-artifacts").rglob("*")
    assert not any(b"secret" in path.read_bytes() for path in copies if path.is_file())


def test_links_inside_a_run_folder_are_followed(root: Path) -> None:
    (root / "good" / "videos" / "last.mp4").symlink_to("frames_000000040960.mp4")
    check_links(root / "good")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("task.id", "../../../../escape/x"),
        ("task.id", "/abs"),
        ("task.motion", "../x"),
        ("task.objects", "[../../x]"),
        ("hand.name", "../x"),
        ("algo.name", "../x"),
    ],
)
def test_names_in_settings_are_no_paths(key: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} .* is not valid"):
        compose(["task=cup-pour1", f"{key}={value}"])


def test_an_own_task_file_whose_id_is_a_path(tmp_path: Path) -> None:
    text = "defaults: [cup-pour1, _self_]\nid: ../../../../escape/x\n"
    (tmp_path / "my" / "task").mkdir(parents=True)
    (tmp_path / "my" / "task" / "evil.yaml").write_text(text)
    flags = (f"--config-dir={tmp_path / 'my'}", "task=evil", "--dry-run")
    outcome = command("pgdm-run", *flags)
    assert outcome.code != 0 and "task.id '../../../../escape/x' is not valid" in outcome.err


@pytest.mark.parametrize("run_id", ["/abs/path", "../../x", "a/b"])
def test_run_ids_of_a_server_are_no_paths(tmp_path: Path, run_id: str) -> None:
    run: Any = SimpleNamespace(info=SimpleNamespace(run_id=run_id, run_name="x"))
    with pytest.raises(ConfigError, match=r"the run id of 'x' in MLflow .* is not valid"):
        source._copied(None, run, tmp_path / "out")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_terms_that_mlflow_would_refuse_are_refused_at_the_start() -> None:
    whole = recipe(compose(["task=cup-pour1"]).method)
    term = RewardTerm("near (5 %)", 1.0, lambda context: context.t)
    with pytest.raises(ConfigError, match=r"name of a RewardTerm 'near \(5 %\)' is not valid"):
        type(whole)((*whole.rewards, term), whole.ends, whole.metrics)
    with pytest.raises(ConfigError, match="name of a Measure 'a/b'"):
        type(whole)(
            whole.rewards, whole.ends, whole.metrics, measures=(Measure("a/b", term.value),)
        )


@pytest.mark.parametrize("seed", ["range(0,10000000)", "range(0,1000000000000)", "choice(1,2)"])
def test_sweeps_of_more_jobs_than_anybody_wants(seed: str) -> None:
    start = time.monotonic()
    limit = ("sweep.most_jobs=1",) if "choice" in seed else ()
    outcome = command("pgdm-run", "-m", "task=cup-pour1", f"seed={seed}", "--dry-run", *limit)
    assert outcome.code != 0 and "type a greater sweep.most_jobs" in outcome.err
    assert time.monotonic() - start < 10


def test_the_limit_of_jobs_is_not_raised_by_a_file(tmp_path: Path) -> None:
    (tmp_path / "big.yaml").write_text("task: cup-pour1\nsweep.most_jobs: 1000000000\n")
    outcome = command("pgdm-run", f"+sweep={tmp_path / 'big.yaml'}", "--dry-run")
    assert outcome.code != 0 and "sweep.most_jobs is refused" in outcome.err


@pytest.mark.parametrize("kind", ["no bytes", "no rows"])
def test_an_emptied_ledger_is_rebuilt(tmp_path: Path, kind: str) -> None:
    whole = plan(tmp_path / "runs" / "sweeps" / "study", 2)
    write_plan(whole)
    Ledger(whole.folder).add(whole)
    file = whole.folder / FILE
    if kind == "no bytes":
        for path in whole.folder.glob(f"{FILE}*"):
            path.unlink()
        file.touch()
    else:
        with contextlib.closing(sqlite3.connect(file)) as database, database:
            database.execute("delete from jobs")
    outcome = command("pgdm", "sweep", "status", str(whole.folder))
    assert outcome.code == 0 and "0 of 64 frames" in outcome.out


def test_logs_of_a_sweep_that_are_no_files(tmp_path: Path) -> None:
    whole = plan(tmp_path / "runs" / "sweeps" / "study", 1)
    write_plan(whole)
    Ledger(whole.folder).add(whole)
    log = log_path(whole.folder, whole.jobs[0].name, 0)
    log.parent.mkdir(exist_ok=True)
    log.symlink_to("/dev/zero")
    outcome = command("pgdm", "sweep", "logs", str(whole.folder), "seed=0")
    assert outcome.code != 0 and "not a file" in outcome.errors[0]


@pytest.mark.parametrize(
    "text",
    [
        '{"jobs": null}',
        '{"jobs": NaN}',
        '{"jobs": [3]}',
        '{"jobs": [{"config": "x"}]}',
        '{"jobs": [{"config": {"run_dir": 5}}]}',
        '{"jobs": [{"config": {"run_dir": "a", "seed": null}}]}',
    ],
)
def test_a_plan_of_wrong_types_blocks_no_report(root: Path, tmp_path: Path, text: str) -> None:
    (root / "study").mkdir()
    (root / "study" / PLAN).write_text(text)
    found = source.find([str(root)], None, tmp_path / "out", silent)
    assert {run.path.name for run in found.runs} == {"good", "bad"}
    assert "it is damaged" in found.unreadable[str(root / "study" / PLAN)]


@pytest.mark.parametrize("success", [1.7, 1e308, -5.0])
def test_a_report_of_rates_that_are_none(root: Path, tmp_path: Path, success: float) -> None:
    log = RunFolder(root / "bad").log
    metrics = {"eval_sampled/success": success}
    log.append(metrics, kind="eval", frames=LENGTH * STEP * 2, iteration=99, time_s=99.0)
    outcome = command("pgdm", "report", str(root), "--out", str(tmp_path / "report"))
    assert (outcome.code, outcome.errors) == (0, []), outcome.err


def test_folders_without_end(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)
    for _ in range(2000):
        os.mkdir("d")
        os.chdir("d")
    monkeypatch.undo()
    assert [run.path.name for run in find_runs(root)] == ["bad", "good"]
    outcome = command("pgdm", "runs", str(root))
    assert outcome.code == 0 and "good" in outcome.out, outcome.err
    subprocess.run(["rm", "-rf", str(root / "d")], check=True)  # deeper than Python can remove
