"""The real commands, run inside the test's process, and what they leave behind."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
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
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The lines of stderr that tell an error."""
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
    """Run a command as a process of its own, after the Python statement ``before``."""
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


@contextlib.contextmanager
def unchanged(*folders: Path) -> Iterator[None]:
    """Check that nothing in the folders has changed, appeared or gone meanwhile."""
    before = [_content(folder) for folder in folders]
    yield
    assert [_content(folder) for folder in folders] == before


def _content(folder: Path) -> dict[str, bytes | None]:
    files = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    return {str(path): path.read_bytes() if path.is_file() else None for path in files}
