"""The real commands, run inside the test's process or as a process of their own."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pgdm.cli import main, run

TINY = (
    "num_envs=2",
    "num_threads=1",
    "algo.steps_per_env=8",
    "algo.minibatch_size=16",
    "total_frames=32",
    "eval.episodes=1",
    "eval.video=false",
    "tracking=none",
    "budget=smoke",
)
"""A run of two iterations."""
TINY_SAC = (
    *(setting for setting in TINY if "minibatch" not in setting),
    "algo=sac",
    "algo.hidden=[16]",
    "algo.batch_size=8",
    "algo.warmup_steps=2",
)
"""The same with soft actor-critic."""


@dataclass(frozen=True)
class Outcome:
    """Result of a command."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """Error lines of stderr."""
        return [line for line in self.err.splitlines() if line.startswith("error: ")]


def command(name: str, *arguments: str) -> Outcome:
    """Run ``pgdm-run`` or ``pgdm`` in this process."""
    entry = {"pgdm-run": run.main, "pgdm": main.main}[name]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = entry(arguments)
    return Outcome(code, out.getvalue(), err.getvalue())


def process(
    name: str,
    *arguments: str,
    env: dict[str, str] | None = None,
    before: str = "pass",
    timeout_s: float = 300,
) -> Outcome:
    """Run a command in its own process, after the Python statement ``before``."""
    module = {"pgdm-run": "run", "pgdm": "main"}[name]
    code = f"import sys; {before}; from pgdm.cli.{module} import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        env=os.environ | (env or {}),
        timeout=timeout_s,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


def in_terminal(columns: int, *arguments: str) -> list[str]:
    """Return the lines that ``pgdm`` prints to a terminal of a width, without colours."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    env = {**os.environ, "TERM": "xterm"}
    env.pop("COLUMNS", None)
    line = [sys.executable, "-m", "pgdm", *arguments]
    with subprocess.Popen(line, stdin=theirs, stdout=theirs, stderr=theirs, env=env) as running:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # how a terminal ends on Linux
            while part := os.read(ours, 1 << 16):
                shown += part
    os.close(ours)
    assert running.returncode == 0, shown
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode()).splitlines()


@contextlib.contextmanager
def unchanged(*folders: Path) -> Iterator[None]:
    """Check that nothing in the folders is changed, added or removed meanwhile."""
    before = [_content(folder) for folder in folders]
    yield
    assert [_content(folder) for folder in folders] == before


def _content(folder: Path) -> dict[str, bytes | None]:
    files = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    return {str(path): path.read_bytes() if path.is_file() else None for path in files}
