from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from command_line import command
from fake_runs import empty_database, end, make, train
from pgdm.cli.dashboard import HOST, _command, dashboard, free_port
from pgdm.errors import RunError
from pgdm.runs.files import LINK, read_json
from pgdm.runs.folder import RunFolder

__all__ = ["empty_database"]  # a fixture

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PROGRAM = "import typer; from pgdm.cli.dashboard import dashboard; typer.run(dashboard)"
PATIENCE_S = 240.0


def test_port_that_is_taken_is_not_used() -> None:
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        listener.listen()
        taken = listener.getsockname()[1]
        other = free_port(taken)
        assert other != taken
    assert free_port(other) == other


@pytest.mark.parametrize("words", ["dashboard", "pregrasp label hammer-use1"])
def test_port_is_at_most_65535(words: str) -> None:
    for port in ("99999", "-1"):
        found = command("pgdm", *words.split(), "--port", port)
        assert found.code == 2 and f"--port {port} is no port: give 1 to 65535" in found.err


def test_folder_without_runs_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no runs in .*runs'; `pgdm-run` starts one"):
        dashboard()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("host", "allowed"),
    [
        ("127.0.0.1:5000", True),
        ("localhost:8000", True),  # forwarded by ssh
        ("10.evil.example", False),
        ("192.168.evil.com", False),
        ("192.168.evil.com:5000", False),
        ("10.0.0.1:5000", False),
        ("localhost.evil.com", False),
    ],
)
def test_names_that_others_may_point_here_are_refused(
    tmp_path: Path, host: str, allowed: bool
) -> None:
    from mlflow.server.security_utils import is_allowed_host_header

    command = _command(f"sqlite:///{tmp_path}/x.db", tmp_path, 5000)
    hosts = command[command.index("--allowed-hosts") + 1].split(",")
    assert is_allowed_host_header(hosts, host) == allowed


def test_server_has_pages_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    dashboard(uri="http://mlflow.example:5000")
    assert "http://mlflow.example:5000" in capsys.readouterr().out


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    folder = make(tmp_path / "runs" / "hammer-use1" / "pgdm" / "s0")
    train(folder)
    end(folder)
    return RunFolder(folder.path)


@pytest.fixture
def served(folder: RunFolder, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the command as from a terminal, in an environment that is not activated."""
    env = {**os.environ, "PATH": "/usr/bin:/bin", "PYTHONUNBUFFERED": "1"}
    env.pop("VIRTUAL_ENV", None)
    command = [sys.executable, "-c", PROGRAM, "--port", "0"]
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "Ctrl-C" in line:
            break
    found = re.search(rf"http://{HOST}:\d+/\S+", "".join(lines))
    assert found and "is taken" not in "".join(lines), lines
    yield process, found.group()
    process.send_signal(signal.SIGINT)  # if killed it could not stop its server
    process.wait(60)
    process.stdout.close()


def group_of(port: int) -> list[int]:
    """Return the processes that mention a port on their command line."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                line = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if str(port).encode() in line and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def page_shows(url: str, texts: tuple[str, ...], tmp_path: Path) -> bool:
    """Return whether a browser builds a page with these texts; a busy machine gets more time."""
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += ["--no-first-run", "--disable-default-apps", "--window-size=1500,1100"]
    command += [f"--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE {HOST}"]  # no other machine
    for wait_ms in (30_000, 90_000, 180_000):
        profile = tempfile.mkdtemp(dir=tmp_path)
        budget = [f"--user-data-dir={profile}", f"--virtual-time-budget={wait_ms}"]
        done = subprocess.run(
            [*command, *budget, "--dump-dom", url],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
        if all(text in done.stdout for text in texts):
            return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stops_cleanly(
    number: signal.Signals, served: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    process, url = served
    port = int(url.split(":")[2].split("/")[0])
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with direct.open(f"http://{HOST}:{port}/health", timeout=30) as answer:
        assert answer.status == 200
    for host in ("10.evil.example", "192.168.evil.com", f"evil.example:{port}"):
        request = urllib.request.Request(f"http://{HOST}:{port}/", headers={"Host": host})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            direct.open(request, timeout=30)
    with socket.socket() as probe:  # only this machine: not on the addresses others reach
        assert probe.connect_ex((HOST, port)) == 0
    assert len(group_of(port)) >= 2
    process.send_signal(number)
    assert process.wait(60) == 0
    assert process.stdout is not None and "dashboard closed" in process.stdout.read()
    deadline = time.monotonic() + 10
    while group_of(port):
        assert time.monotonic() < deadline
        time.sleep(0.2)
    assert not (tmp_path / "mlruns").exists()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_browser_shows_the_run(
    served: tuple[subprocess.Popen[str], str], folder: RunFolder, tmp_path: Path
) -> None:
    _, url = served
    assert page_shows(
        url, ("hammer-use1 s0 pgdm", "Model training", "eval_sampled/success"), tmp_path
    )
    run_id = read_json(folder.path / LINK)["run_id"]
    page = url.split("/runs?")[0] + f"/runs/{run_id}"
    overview = ("Finished", "pregrasp_source", "asset_source", "eval_sampled/success")
    assert page_shows(page, overview, tmp_path)
    charts = ("eval_deterministic", "com_error_released")
    assert page_shows(f"{page}/model-metrics", charts, tmp_path)
    files = ("config.yaml", "checkpoints", "videos")
    assert page_shows(f"{page}/artifacts", files, tmp_path)
