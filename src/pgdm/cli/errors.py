"""Errors as people see them: one line that names the wrong value and the cure, and an exit code."""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from pgdm.errors import ConfigError, PgdmError

USAGE = 2
"""Exit code: a setting, an option or a name is wrong."""
FAILED = 1
"""Exit code: the command was right, and failed."""
INTERRUPTED = 130
"""Exit code: stopped from outside (128 + SIGINT); SIGTERM gives 143."""

EXPECTED = (PgdmError, OSError, MemoryError, KeyboardInterrupt)
"""Errors that no program can rule out."""

_CURES = {
    errno.ENOSPC: "the disk is full; make room and start the same command again",
    errno.EDQUOT: "the disk quota is used up; make room and start the same command again",
    errno.EFBIG: "the file has reached the size limit of this account; raise it (ulimit -f)",
    errno.EROFS: "it is on a read-only file system; choose another folder (run_dir=..., PGDM_HOME)",
    errno.EACCES: "permission is missing; change it, or choose another folder (run_dir=...)",
    errno.EPERM: "permission is missing; change it, or choose another folder (run_dir=...)",
    errno.ENOTDIR: "a file stands where a folder is needed; choose another folder",
    errno.EEXIST: "a file stands where a folder is needed; choose another folder",
    errno.EISDIR: "a folder stands where a file is needed; choose another name",
    errno.ENOENT: "there is no such file or folder; check the path",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


# What MuJoCo takes on Linux; with anything else its import itself fails.
_OPENGL = ("", "egl", "osmesa", "glfw", "glx", "enable", "enabled", "on", "true", "1")
_NO_OPENGL = ("disable", "disabled", "off", "false", "0")


def check_environment() -> None:
    """Check the variables that are read before any of pgdm's own code can.

    Raises:
        ConfigError: if one has a value that nothing understands.
    """
    value = os.environ.get("MUJOCO_GL", "")
    if value.lower().strip() not in (*_OPENGL, *_NO_OPENGL):
        raise ConfigError(
            f"the environment's MUJOCO_GL is '{value}'; valid: egl, osmesa, glfw, disable; "
            "unset it to have pgdm choose"
        )


def message(error: BaseException) -> str:
    """Return what a user should read, on one line."""
    if isinstance(error, PgdmError):
        text = str(error)
    elif isinstance(error, KeyboardInterrupt):
        text = "interrupted; a run goes on from its last checkpoint by the same command"
    elif isinstance(error, MemoryError):
        text = "out of memory; use fewer simulations (num_envs=...) or a smaller algo.hidden"
    elif isinstance(error, OSError):
        text = _os_message(error)
    else:
        text = f"{type(error).__name__}: {error} ({_culprit(error)})"
    return " ".join(text.split())


def _culprit(error: BaseException) -> str:
    """Return whose defect an unexpected error is: a person's own method's, else pgdm's."""
    ours = Path(__file__).resolve().parents[1], Path(sys.prefix), Path(sys.base_prefix)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename).resolve()
        if path.is_file() and not any(path.is_relative_to(place) for place in ours):
            return f"in {path}, line {frame.lineno}; --debug shows how it came there"
    return "a defect of pgdm: please report it with what --debug shows"


def _os_message(error: OSError) -> str:
    name = f"'{error.filename}': " if error.filename else ""
    cure = _CURES.get(error.errno or 0)
    if cure is None:
        return f"{name}{error.strerror or error}"
    return f"{name}{cure}"


def exit_code(error: BaseException) -> int:
    """Return the exit code that tells what kind of error it was."""
    if isinstance(error, ConfigError):
        return USAGE
    return INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED


def report(error: BaseException, debug: bool) -> int:
    """Print an error to stderr, its traceback only for ``debug``, and return the exit code."""
    if isinstance(error, BrokenPipeError):
        return FAILED  # who read our output has gone, as ``head`` does
    if debug:
        traceback.print_exception(error)
    print(f"error: {message(error)}", file=sys.stderr, flush=True)
    return exit_code(error)


def guarded(command: Callable[[], int], debug: bool) -> int:
    """Run a command and return its exit code; errors become one line on stderr."""
    with _one_line(debug):
        try:
            return _flushed(command())
        except EXPECTED as error:
            return report(error, debug)


def _flushed(code: int) -> int:
    """Write out what was printed, while an error can still be told."""
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter would try again when it ends, and complain in its own words.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise
    return code


@contextmanager
def _one_line(debug: bool) -> Iterator[None]:
    """Show also an error that nobody expected as one line, while inside.

    It uses the interpreter's hook, and catches nothing: what goes wrong still ends the process.
    """

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        del kind, trace
        report(error, debug)

    before, sys.excepthook = sys.excepthook, hook
    yield
    # Reached only if all went well: on an error the hook must outlive this function.
    sys.excepthook = before
