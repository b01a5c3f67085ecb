"""``pgdm dashboard``: MLflow's web pages for a folder of runs, served to this machine only."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import IO, Annotated, Any

import typer

from pgdm import paths
from pgdm.cli.console.screen import bars, notify
from pgdm.cli.options import Port, Runs
from pgdm.errors import RunError, TrackingError
from pgdm.runs.folder import ARTIFACTS, find_runs
from pgdm.tracking.address import chosen
from pgdm.tracking.mlflow import environment, sqlite_file, store_uri

HOST = "127.0.0.1"
"""This machine only, since MLflow asks for no password."""
START_S = 120.0
_STOP_S = 5.0
_VIEW = "pgdm"
"""Key under which MLflow stores the choice of columns in the table of runs."""
_COLUMNS = [
    "metrics.`eval_sampled/success`",
    "metrics.`train/steps_per_s`",
    "tags.`task`",
    "tags.`seed`",
]
"""Columns that the table shows besides names and times, written as MLflow's page writes them."""
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # without a proxy
_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def dashboard(
    root: Runs = None,
    port: Port = 5000,
    uri: Annotated[
        str | None,
        typer.Option(
            help="MLflow store to show, such as sqlite:////data/x.db [MLFLOW_TRACKING_URI, else "
            "mlflow.db in DIR]."
        ),
    ] = None,
) -> None:
    """Serve MLflow's web pages for a folder of runs; Ctrl-C quits.

    The pages are served to this machine only, at the address that is printed.
    """
    root = (root or paths.runs()).absolute()
    address = chosen(uri, "--uri", notify) or store_uri(root)
    if address.startswith(("http://", "https://")):
        print(f"{address} is an MLflow server with pages of its own: open it in a browser")
        return
    _ensure_store(address, root)
    free = free_port(port)
    if port not in (0, free):
        print(f"port {port} is taken, using {free}")
    with tempfile.TemporaryFile() as output, _served(_command(address, root, free), output) as ui:
        url = f"http://{HOST}:{free}"
        _wait_until_up(ui, url, output)
        print(f"the runs in {root} are shown at\n  {url}{_page(url)}\nCtrl-C quits", flush=True)
        code = ui.wait()
        raise TrackingError(f"MLflow's server exited with code {code}: {_last_line(output)}")


def free_port(wanted: int) -> int:
    """Return ``wanted`` if it is free, else another free port."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return probe.getsockname()[1]
    raise TrackingError(f"no port is free on {HOST}")


def _ensure_store(uri: str, root: Path) -> None:
    """Fill a SQLite store from the run folders if its file is missing."""
    file = sqlite_file(uri)
    if file is None or file.exists():
        return
    if not root.is_dir() or not find_runs(root):
        raise RunError(f"there are no runs in '{root}'; `pgdm-run` starts one, or name a folder")
    from pgdm.tracking.sync import sync

    print(f"{file} does not exist yet: filling it from the run folders")
    sync(root, uri, lambda done: notify(f"{done.action:<11}{done.folder.path}"))


def _command(uri: str, root: Path, port: int) -> list[str]:
    # This interpreter has MLflow, whether its environment is activated or not.
    command = [sys.executable, "-m", "mlflow", "server", "--host", HOST, "--port", str(port)]
    command += ["--backend-store-uri", uri, "--workers", "1", "--no-serve-artifacts"]
    # By default MLflow also accepts host names such as 10.evil.example. Whoever owns such a name
    # can make it resolve to this machine (DNS rebinding); the browser then lets their site read
    # the runs.
    command += ["--allowed-hosts", ",".join((HOST, f"{HOST}:*", "localhost", "localhost:*"))]
    return [*command, "--default-artifact-root", str(root / ARTIFACTS)]


@contextlib.contextmanager
def _served(command: list[str], output: IO[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Run the server; stop it and its children however the with block ends."""
    env = {**environment(), "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    with on_stop(_stop):
        server = subprocess.Popen(
            command,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # a new process group, which _kill ends as a whole
        )
        try:
            yield server
        except _StopError:
            print("dashboard closed")
        finally:
            _kill(server)


@contextlib.contextmanager
def on_stop(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Call a handler on SIGINT, SIGTERM and SIGHUP within the with block."""
    before = {number: signal.signal(number, handler) for number in _STOPPERS}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


class _StopError(Exception):
    """A stop signal has arrived."""


def _stop(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise _StopError


def _kill(server: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            server.wait(_STOP_S)
            return


def _wait_until_up(server: subprocess.Popen[bytes], url: str, output: IO[bytes]) -> None:
    notify(f"starting MLflow's server and waiting for it to answer at {url}")
    begin = time.monotonic()
    with bars() as progress:
        while (waited_s := time.monotonic() - begin) < START_S:
            progress("waiting for MLflow [s]", int(waited_s), 0)
            if server.poll() is not None:
                raise TrackingError(f"MLflow's server does not start: {_last_line(output)}")
            try:
                with _DIRECT.open(f"{url}/health", timeout=2):
                    return
            except (urllib.error.URLError, TimeoutError, ConnectionError):
                time.sleep(0.2)
    raise TrackingError(f"MLflow's server does not answer at {url}: {_last_line(output)}")


def _page(url: str) -> str:
    """Return the path of the latest experiment's page, or of the list if no experiment exists."""
    query = {"max_results": 100, "order_by": ["last_update_time DESC"]}
    found = _asked(f"{url}/api/2.0/mlflow/experiments/search", query).get("experiments", [])
    ours = [str(e["experiment_id"]) for e in found if e.get("name") != "Default"]
    if not ours:
        return "/#/experiments?workflowType=machine_learning"
    # The page reads the columns to show from a tag that its "Share" button would set.
    view = json.dumps({"selectedColumns": _COLUMNS})
    tag = {"experiment_id": ours[0], "key": f"mlflow.sharedViewState.{_VIEW}", "value": view}
    _asked(f"{url}/api/2.0/mlflow/experiments/set-experiment-tag", tag)
    query = f"workflowType=machine_learning&viewStateShareKey={_VIEW}"
    return f"/#/experiments/{ours[0]}/runs?{query}"


def _asked(address: str, content: dict[str, Any]) -> dict[str, Any]:
    """Return MLflow's answer to a request; empty if there is none."""
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(address, json.dumps(content).encode(), headers)
    try:
        with _DIRECT.open(request, timeout=30) as answer:
            return json.load(answer)
    except (OSError, ValueError):
        return {}


def _last_line(output: IO[bytes]) -> str:
    output.seek(0)
    lines = output.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"
