"""Processing of untrusted files in a child process, with limits of time and memory.

A valid mesh or model may still take hours or terabytes to load. Neither MuJoCo nor the mesh readers
can be interrupted, and they kill the process when memory runs out.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import IO, Any, TypeVar

from pgdm.errors import LimitError

R = TypeVar("R")

SECONDS = 10
"""CPU time for one call, s."""
MEMORY = 4 << 30
"""Address space of the child, bytes."""
_WALL_S = 120  # wall-clock time granted beyond the CPU time, for a child that waits, s


def each(
    function: Callable[..., R], calls: Sequence[tuple[Any, ...]], seconds: int = SECONDS
) -> list[R | Exception]:
    """Call a function several times in one child process.

    Args:
        function: a module-level function; arguments and results are pickled.
        calls: the arguments of each call.
        seconds: CPU time for each call, s.

    Returns:
        What each call returned or raised, in order; a LimitError ends the list.
    """
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # each thread reserves memory
    path = os.pathsep.join(entry for entry in sys.path if entry)
    answers: list[R | Exception] = []
    with subprocess.Popen(
        [sys.executable, "-P", "-m", __name__, str(seconds), str(MEMORY)],
        env={**os.environ, **threads, "PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as child:
        assert child.stdin is not None and child.stdout is not None
        try:
            with child.stdin as there, contextlib.suppress(BrokenPipeError):
                pickle.dump((function, list(calls)), there)
            while len(answers) < len(calls):
                answers.append(_answer(child, child.stdout, seconds))
                if isinstance(answers[-1], LimitError):
                    break
        finally:
            child.kill()
    return answers


def call(function: Callable[..., R], *arguments: Any, seconds: int = SECONDS) -> R:
    """Return what a function returns, called in a child process as by ``each``.

    Raises:
        LimitError: if it exceeds a limit.
        Exception: whatever the function raises.
    """
    (answer,) = each(function, [arguments], seconds)
    if isinstance(answer, Exception):
        raise answer
    return answer


def _answer(child: subprocess.Popen[bytes], stream: IO[bytes], seconds: int) -> Any:
    ready, _, _ = select.select([stream], [], [], _WALL_S + seconds)
    if not ready:
        return LimitError(f"it takes more than {_WALL_S + seconds} s")
    try:
        return pickle.load(stream)
    except (EOFError, pickle.UnpicklingError):
        if child.wait() == -signal.SIGXCPU:
            return LimitError(f"it takes more than {seconds} s of computing")
        return LimitError(
            f"it needs more than {MEMORY >> 30} GB, or the library that reads it crashes"
        )


def _main(seconds: int, memory: int) -> None:
    """Answer the calls on stdin, each with its result or the exception."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keep what libraries print out of the answers
    function, calls = pickle.load(sys.stdin.buffer)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    for arguments in calls:
        most = int(time.process_time()) + 1 + seconds
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
        try:
            answer = function(*arguments)
        except MemoryError:
            return
        except Exception as error:  # noqa: BLE001 (raised again where the call was made)
            answer = error
        answers.write(pickle.dumps(answer))
        answers.flush()


if __name__ == "__main__":
    _main(int(sys.argv[1]), int(sys.argv[2]))
