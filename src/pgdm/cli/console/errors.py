"""Report errors to the user: one line with the wrong value and a remedy, and an exit code."""

from __future__ import annotations

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import TracebackType

from pgdm.cli.console.printable import Printable, printable
from pgdm.errors import ConfigError, PgdmError
from pgdm.sim.gl import deferred

USAGE = 2
"""Exit code: a setting, an option or a name is wrong."""
FAILED = 1
"""Exit code: the command was valid, but failed."""
INTERRUPTED = 130
"""Exit code: stopped by a signal (128 + SIGINT); SIGTERM gives 143."""

EXPECTED = (PgdmError, OSError, MemoryError, KeyboardInterrupt)
"""Errors that are not bugs in pgdm."""

_CURES = {
    errno.ENOSPC: "the disk is full; make room and run the same command again",
    errno.EDQUOT: "the disk quota is used up; make room and run the same command again",
    errno.EFBIG: "the file has reached the size limit of this account; raise it (ulimit -f)",
    errno.EROFS: "it is on a read-only file system; choose another folder (run_dir=..., PGDM_HOME)",
    errno.EACCES: "permission is missing; change it, or choose another folder (run_dir=...)",
    errno.EPERM: "permission is missing; change it, or choose another folder (run_dir=...)",
    errno.ENOTDIR: "there is a file where a folder is needed; choose another folder",
    errno.EEXIST: "there is a file where a folder is needed; choose another folder",
    errno.EISDIR: "there is a folder where a file is needed; choose another name",
    errno.ENOENT: "there is no such file or folder; check the path",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


def message(error: BaseException) -> str:
    """Return the message for the user, on one line."""
    if isinstance(error, PgdmError):
        text = str(error)
    elif isinstance(error, KeyboardInterrupt):
        text = "interrupted; the same command resumes a run from its last checkpoint"
    elif isinstance(error, MemoryError):
        text = "out of memory; use fewer simulations (num_envs=...) or a smaller algo.hidden"
    elif isinstance(error, OSError):
        text = _os_message(error)
    else:
        text = f"{type(error).__name__}: {error} ({_culprit(error)})"
    return printable(" ".join(text.split()))


def _culprit(error: BaseException) -> str:
    """Return where an unexpected error arose: in the user's own code, else in pgdm."""
    ours = Path(__file__).resolve().parents[2], Path(sys.prefix), Path(sys.base_prefix)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename).resolve()
        if path.is_file() and not any(path.is_relative_to(place) for place in ours):
            return f"in {path}, line {frame.lineno}; --debug shows the traceback"
    return "a bug in pgdm: please report it with the output of --debug"


def _os_message(error: OSError) -> str:
    name = f"'{error.filename}': " if error.filename else ""
    cure = _CURES.get(error.errno or 0)
    if cure is None:
        return f"{name}{error.strerror or error}"
    return f"{name}{cure}"


def exit_code(error: BaseException) -> int:
    """Return the exit code for the kind of error."""
    if isinstance(error, ConfigError):
        return USAGE
    return INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED


def report(error: BaseException, debug: bool) -> int:
    """Print an error to stderr, its traceback only for ``debug``, and return the exit code."""
    if isinstance(error, BrokenPipeError):
        return FAILED  # the reader of the output has exited, as ``head`` does
    if debug:
        traceback.print_exception(error)
    print(f"error: {message(error)}", file=sys.stderr, flush=True)
    return exit_code(error)


def guarded(command: Callable[[], int], debug: bool) -> int:
    """Run a command and return its exit code; errors become one line on stderr."""
    _open_streams()
    if any(option.startswith("error") for option in sys.warnoptions):
        # pgdm's users cannot fix what libraries warn about: do not turn it into errors.
        warnings.simplefilter("default")
    with _one_line(debug), deferred(), _printable():
        try:
            return _flushed(command())
        except EXPECTED as error:
            return report(error, debug)


def _open_streams() -> None:
    """Replace closed standard streams (``>&-``), so that no file gets their descriptors."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (it stays open)


@contextmanager
def _printable() -> Iterator[None]:
    """Escape control characters in all that is printed within the with block."""
    out, err = (stream and Printable(stream) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield


def _flushed(code: int) -> int:
    """Flush stdout while an error can still be reported."""
    try:
        sys.stdout.flush()
    except OSError:
        # Otherwise the interpreter would flush again at exit, and print its own error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise
    return code


@contextmanager
def _one_line(debug: bool) -> Iterator[None]:
    """Print unexpected errors as one line, too.

    This replaces ``sys.excepthook`` and catches nothing: an error still ends the process.
    """

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        del kind, trace
        report(error, debug)

    before, sys.excepthook = sys.excepthook, hook
    yield
    # Not reached after an error: the hook must then stay, since the interpreter calls it later.
    sys.excepthook = before
