"""``pgdm dashboard``: MLflow's pages over a folder of runs, for this machine only."""

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
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import IO, Annotated

import typer

from pgdm import paths
from pgdm.errors import RunError, TrackingError
from pgdm.tracking.mlflow import environment, sqlite_file, store_uri
from pgdm.tracking.run_folder import ARTIFACTS, find_runs

HOST = "127.0.0.1"
"""Only this machine: MLflow asks for no password."""
START_S = 120.0
_STOP_S = 5.0
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # never by a proxy
_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def dashboard(
    root: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="Folder of runs [runs].")
    ] = None,
    port: Annotated[int, typer.Option(help="Port; another one is taken if it is in use.")] = 5000,
    uri: Annotated[
        str | None, typer.Option(help="Another MLflow database, such as sqlite:////data/x.db.")
    ] = None,
) -> None:
    """Show runs in the browser (MLflow, on this machine only); Ctrl-C ends it."""
    root = (root or paths.runs()).absolute()
    if uri is not None and uri.startswith(("http://", "https://")):
        print(f"{uri} is an MLflow server with pages of its own: open it in a browser")
        return
    address = uri or store_uri(root)
    _ensure_store(address, root)
    chosen = free_port(port)
    if chosen != port:
        print(f"port {port} is taken, using {chosen}")
    with tempfile.TemporaryFile() as output, _served(_command(address, root, chosen), output) as ui:
        url = f"http://{HOST}:{chosen}"
        _wait_until_up(ui, url, output)
        print(f"the runs in {root} are shown at\n  {url}{_page(url)}\nCtrl-C ends it", flush=True)
        code = ui.wait()
        raise TrackingError(f"MLflow's pages ended with code {code}: {_last_line(output)}")


def free_port(wanted: int) -> int:
    """Return ``wanted`` if nobody listens there, else a port that is free."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except (OSError, OverflowError):
                continue
            return probe.getsockname()[1]
    raise TrackingError(f"no port is free on {HOST}")


def _ensure_store(uri: str, root: Path) -> None:
    """Fill a store that is missing from the runs themselves."""
    file = sqlite_file(uri)
    if file is None or file.exists():
        return
    if not root.is_dir() or not find_runs(root):
        raise RunError(f"there are no runs in '{root}'; `pgdm-run` starts one, or name a folder")
    from pgdm.tracking.sync import sync

    print(f"{file} does not exist yet: made from the run folders")
    sync(root, uri)


def _command(uri: str, root: Path, port: int) -> list[str]:
    # The interpreter that runs this has MLflow, whether its environment is activated or not.
    command = [sys.executable, "-m", "mlflow", "server", "--host", HOST, "--port", str(port)]
    command += ["--backend-store-uri", uri, "--workers", "1", "--no-serve-artifacts"]
    return [*command, "--default-artifact-root", str(root / ARTIFACTS)]


@contextlib.contextmanager
def _served(command: list[str], output: IO[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Run the server, and end it and its children together, whatever ends this process."""
    env = {**environment(), "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    before = {number: signal.signal(number, _stop) for number in _STOPPERS}
    server = subprocess.Popen(
        command,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # a group of its own: signals reach its workers, not us
    )
    try:
        yield server
    except _StopError:
        print("dashboard ended")
    finally:
        _end(server)
        for number, handler in before.items():
            signal.signal(number, handler)


class _StopError(Exception):
    """Asked to end."""


def _stop(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise _StopError


def _end(server: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            server.wait(_STOP_S)
            return


def _wait_until_up(server: subprocess.Popen[bytes], url: str, output: IO[bytes]) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        if server.poll() is not None:
            raise TrackingError(f"MLflow's pages do not start: {_last_line(output)}")
        try:
            with _DIRECT.open(f"{url}/health", timeout=2):
                return
        except (urllib.error.URLError, TimeoutError, ConnectionError):
            time.sleep(0.2)
    raise TrackingError(f"MLflow's pages do not answer at {url}: {_last_line(output)}")


def _page(url: str) -> str:
    """Return the page of the experiment used last, or the list of experiments."""
    query = json.dumps({"max_results": 100, "order_by": ["last_update_time DESC"]}).encode()
    address = f"{url}/api/2.0/mlflow/experiments/search"
    request = urllib.request.Request(address, query, {"Content-Type": "application/json"})
    try:
        with _DIRECT.open(request, timeout=30) as answer:
            found = json.load(answer).get("experiments", [])
    except (OSError, ValueError):
        found = []
    ours = [str(e["experiment_id"]) for e in found if e.get("name") != "Default"]
    place = f"experiments/{ours[0]}/runs" if ours else "experiments"
    return f"/#/{place}?workflowType=machine_learning"


def _last_line(output: IO[bytes]) -> str:
    output.seek(0)
    lines = output.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"
