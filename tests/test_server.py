"""What docs/server.md says, done: PostgreSQL, an MLflow server, and runs that go to it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from command_line import TINY, command, process
from fake_runs import STEP, end, make, train_metrics, truth
from pgdm.cli.dashboard import HOST, free_port
from pgdm.runs.folder import RunFolder, find_runs
from pgdm.runs.log import RunLog
from pgdm.tracking import TrackingCfg, open_tracker
from pgdm.tracking.mlflow import PARENT_TAG, Mirror, Store
from pgdm.tracking.sync import history, sync

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "server.md").read_text(encoding="utf-8")
# Debian keeps these off the path.
PLACES = [*map(str, sorted(Path("/usr/lib/postgresql").glob("*/bin"))), os.environ["PATH"]]
SERVER = shutil.which("pg_ctl", path=os.pathsep.join(PLACES))
# PostgreSQL refuses to run as root.
OWNER = "postgres" if os.getuid() == 0 else None
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
JOB = (*(word for word in TINY if word != "tracking=none"), "offline=true")
WRITERS, POINTS = 8, 200
PATIENCE_S = 300

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(SERVER is None, reason="needs PostgreSQL (Debian: postgresql)"),
    # MLflow warns of what it and its dependencies will change; that is theirs.
    pytest.mark.filterwarnings("ignore"),
]


def typed(start: str) -> list[list[str]]:
    """Return the words of the page's commands that begin like this."""
    found = re.findall(rf"^{start}.*$", PAGE, re.MULTILINE)
    assert found, f"docs/server.md has no '{start}'"
    return [shlex.split(line) for line in found]


class Database:
    """A PostgreSQL server of the test's own, as Debian sets one up where no locale is set.

    Args:
        folder: for its data and its socket.
    """

    def __init__(self, folder: Path) -> None:
        assert SERVER is not None
        self.folder = folder
        path = os.pathsep.join([str(Path(SERVER).parent), os.environ["PATH"]])
        self.env = {**os.environ, "PATH": path, "PGHOST": str(folder)}
        self._data = str(folder / "data")

    def start(self) -> None:
        new = ["-U", "postgres", "--auth=trust", "--locale=C", "--encoding=SQL_ASCII", "--no-sync"]
        self._own("initdb", "-D", self._data, *new)
        options = f"-k {self.folder} -c listen_addresses='' -c fsync=off"
        log = str(self.folder / "log")
        self._own("pg_ctl", "-D", self._data, "-w", "-l", log, "-o", options, "start")

    def stop(self) -> None:
        self._own("pg_ctl", "-D", self._data, "-w", "-m", "fast", "stop")

    def run(self, words: list[str]) -> str:
        """Run a command of the page, which is typed there as the user it names."""
        assert words[:2] == ["runuser", "-u"] and words[3] == "--"
        env = {**self.env, "PGUSER": words[2]}
        done = subprocess.run(words[4:], env=env, check=True, stdout=subprocess.PIPE, text=True)
        return done.stdout

    def _own(self, *words: str) -> None:
        """Run a command as who owns the data."""
        subprocess.run(
            words,
            cwd=self.folder,
            env=self.env,
            stdout=subprocess.DEVNULL,
            check=True,
            user=OWNER,
            group=OWNER,
            extra_groups=[] if OWNER else None,
        )


class Server:
    """The service of the page: its command, at a port of the test's own.

    Args:
        folder: for artifacts.
        env: of the database.
    """

    def __init__(self, folder: Path, env: Mapping[str, str]) -> None:
        self._port = free_port(0)
        self.url = f"http://{HOST}:{self._port}"
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        unit = PAGE.split("```ini\n")[1].split("```")[0].replace("\\\n", " ")
        (settings,) = re.findall(r"^Environment=(.*)$", unit, re.MULTILINE)
        (line,) = re.findall(r"^ExecStart=(.*)$", unit, re.MULTILINE)
        for there, here in {
            "/opt/mlflow/bin/mlflow": f"{sys.executable} -m mlflow",
            "/run/postgresql": env["PGHOST"],
            "/var/lib/mlflow": str(folder),
            "192.168.0.10": HOST,
            "--port 5000": f"--port {self._port}",
        }.items():
            assert there in line
            line = line.replace(there, here)
        self._command = shlex.split(line)
        mine = dict(setting.split("=") for setting in settings.split())
        self._env = {**env, **mine, "PGUSER": "mlflow"}

    def start(self) -> None:
        with open(self._folder / "server.log", "ab") as log:
            self._process = subprocess.Popen(
                self._command, env=self._env, stdout=log, stderr=log, start_new_session=True
            )
        limit = time.monotonic() + PATIENCE_S
        while self.asked("/health") != 200:
            assert self._process.poll() is None, (self._folder / "server.log").read_text()
            assert time.monotonic() < limit
            time.sleep(0.2)

    def kill(self) -> None:
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def asked(self, path: str, **headers: str) -> int:
        """Return the server's answer: 0 if there is none."""
        try:
            request = urllib.request.Request(self.url + path, headers=headers)
            if headers:
                request.data = b'{"max_results": 1}'
            with DIRECT.open(request, timeout=30) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            return error.code
        except OSError:
            return 0

    def typed(self, start: str) -> list[str]:
        """Return the words of the page's one command that begins like this, less its name."""
        first = typed(start)[0]
        return [word.replace("http://server:5000", self.url) for word in first[1:]]


@pytest.fixture(scope="module")
def database() -> Iterator[Database]:
    # Not below pytest's folders, which PostgreSQL's user cannot enter.
    with tempfile.TemporaryDirectory(prefix="pgdm-postgresql-") as name:
        if OWNER:
            shutil.chown(name, OWNER)
        found = Database(Path(name))
        found.start()
        try:
            for words in typed("runuser -u postgres"):
                found.run(words)
            yield found
        finally:
            found.stop()


@pytest.fixture(scope="module")
def server(database: Database, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    found = Server(tmp_path_factory.mktemp("server"), database.env)
    try:
        found.start()
        yield found
    finally:
        found.kill()


def shown(store: Store, folder: RunFolder) -> dict[str, dict[int, float]]:
    return history(store, store.client.get_run(folder.link["run_id"]))


def test_pages_answer_to_the_names_of_the_page(server: Server) -> None:
    search, kind = "/ajax-api/2.0/mlflow/experiments/search", {"Content-Type": "application/json"}
    own = "http://server:5000"
    assert server.asked(search, Host="server:5000", Origin=own, **kind) == 200
    assert server.asked(search, Host="server:5000", Origin="http://elsewhere", **kind) == 403
    assert server.asked(search, Host="elsewhere:5000", Origin=own, **kind) == 403


def test_a_sweep(server: Server, library_home: Path, tmp_path: Path) -> None:
    words = server.typed("pgdm-run -m")
    done = process("pgdm-run", *words, *JOB, "hydra.launcher.max_jobs=2")
    assert done.code == 0, done.err
    assert "MLflow" not in done.err
    store = Store.open(server.url, "handles")
    runs = store.client.search_runs([store.experiment_id])
    (parent,) = [run for run in runs if PARENT_TAG not in run.data.tags]
    folders = find_runs(tmp_path / "runs")
    assert len(folders) == len(runs) - 1 == 3
    assert {run.info.status for run in runs} == {"FINISHED"}
    for folder in folders:
        run = store.client.get_run(folder.link["run_id"])
        assert run.data.tags[PARENT_TAG] == parent.info.run_id
        assert shown(store, folder) == truth(folder)
        for file, place in folder.artifacts():
            name = f"{place}/{file.name}".lstrip("/")
            there = store.client.download_artifacts(run.info.run_id, name, str(tmp_path))
            assert Path(there).read_bytes() == file.read_bytes()
    assert "3 unchanged" in command("pgdm", *server.typed("pgdm runs sync")).out
    assert server.url in command("pgdm", *server.typed("pgdm dashboard")).out
    (tmp_path / "runs").rename("of-another-machine")
    told = command("pgdm", *server.typed("pgdm report"))
    assert told.out.startswith("3 runs (3 finished)"), told.err
    assert "hammer-use1" in (tmp_path / "runs" / "report" / "report.html").read_text()


def test_the_server_is_killed_and_comes_back(
    server: Server, library_home: Path, tmp_path: Path
) -> None:
    words = [*server.typed("pgdm-run task"), *JOB, "tracking.experiment=away", "run_dir=runs/a"]
    program = "import sys; from pgdm.cli.run import main; sys.exit(main())"
    run = subprocess.Popen(
        [sys.executable, "-c", program, *words, "total_frames=8000", "eval.interval_frames=0"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    folder = RunFolder(tmp_path / "runs" / "a")
    store = Store.open(server.url, "away")
    while "run_id" not in folder.link or not shown(store, folder):
        assert run.poll() is None
        time.sleep(0.1)
    server.kill()
    try:
        _, err = run.communicate(timeout=PATIENCE_S)
    finally:
        server.start()
    assert run.returncode == 0, err
    assert "training continues" in err and "pgdm runs sync" in err
    expected = truth(RunFolder(folder.path))
    each = "train/steps_per_s"
    assert len(shown(store, folder)[each]) < len(expected[each]) == 500
    for word in ("completed", "unchanged"):
        assert f"1 {word}" in command("pgdm", *server.typed("pgdm runs sync")).out
        (only,) = store.client.search_runs([store.experiment_id])
        assert (only.info.status, only.data.tags["attempts"]) == ("FINISHED", "1")
        assert shown(store, folder) == expected


def test_records_that_grow_while_they_are_sent(server: Server, tmp_path: Path) -> None:
    folder = make(tmp_path / "a", total_frames=10**6)
    log, stop = RunLog(folder.path / "metrics.jsonl"), threading.Event()
    log.append(train_metrics(0), frames=0, iteration=0, time_s=0.0, kind="train")

    def grow() -> None:
        while not stop.is_set():
            log.append(train_metrics(1), frames=1, iteration=1, time_s=0.0, kind="train")

    mirror = Mirror(Store.open(server.url, "growing"), folder, None)
    writer = threading.Thread(target=grow)
    writer.start()
    try:
        for _ in range(20):
            mirror.artifact(log.path, "")
            mirror.set_status("running")
    finally:
        stop.set()
        writer.join()


def write(path: Path, uri: str) -> None:
    """Record a run as it would itself, as fast as it goes."""
    folder = RunFolder(path)
    tracker = open_tracker(TrackingCfg("mlflow", uri, "writers"), folder, {})
    for i in range(POINTS):
        metrics = train_metrics(i)
        place = {"frames": i * STEP, "iteration": i, "time_s": 0.1 * i}
        folder.log.append(metrics, kind="train", **place)
        tracker.log(metrics, i * STEP)
    end(folder)
    tracker.finish("finished")


def test_many_writers_lose_nothing(server: Server, tmp_path: Path) -> None:
    paths = [tmp_path / "runs" / f"s{seed}" for seed in range(WRITERS)]
    for seed, path in enumerate(paths):
        make(path, seed, total_frames=POINTS * STEP)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pgdm.tracking.live", "mlflow"])
    with ProcessPoolExecutor(WRITERS, context) as pool:
        list(pool.map(write, paths, [server.url] * WRITERS))
    store = Store.open(server.url, "writers")
    runs = store.client.search_runs([store.experiment_id])
    assert [run.info.status for run in runs] == ["FINISHED"] * WRITERS
    for folder in find_runs(tmp_path / "runs"):
        found = shown(store, folder)
        assert found == truth(folder)
        assert {len(steps) for steps in found.values()} == {POINTS}
    done = sync(tmp_path / "runs", server.url)
    assert [one.action for one in done] == ["unchanged"] * WRITERS


def test_back_up(server: Server, database: Database, tmp_path: Path) -> None:
    Store.open(server.url, "kept")
    dump = str(tmp_path / "mlflow.dump")
    for start in ("runuser -u mlflow -- pg_dump", "runuser -u mlflow -- pg_restore"):
        (words,) = typed(start)
        words = [word.replace("/var/lib/mlflow/mlflow.dump", dump) for word in words]
        if "pg_restore" in words:
            (new,) = typed("runuser -u postgres -- createdb")
            database.run([*new[:-1], "restored"])
            words[words.index("mlflow", 4)] = "restored"
        database.run(words)
    query = "select count(*) from experiments where name = 'kept'"
    words = ["runuser", "-u", "mlflow", "--", "psql", "-At", "-c", query, "restored"]
    assert database.run(words) == "1\n"
