"""One thread that does what all pages ask for, one after the other."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Hashable

from pgdm.errors import PgdmError

_log = logging.getLogger(__name__)

Action = Callable[[], None]


class Mailbox:
    """Actions from any thread, done in their order by one.

    Of actions with one key that wait directly behind each other only the last is done: a page
    that drags faster than a machine computes is followed, not queued up.

    Args:
        complain: told why an action failed.
    """

    def __init__(self, complain: Callable[[str], None]) -> None:
        self._complain = complain
        self._waiting: deque[tuple[Hashable, Action]] = deque()
        self._condition = threading.Condition()
        self._busy = self._ended = False
        self.done = 0
        """Actions that were done."""
        self._thread = threading.Thread(target=self._run, name="labeler", daemon=True)
        self._thread.start()

    def post(self, action: Action, key: Hashable = None) -> None:
        """Have an action done; with a key, it takes the place of one that waits as the last."""
        with self._condition:
            if key is not None and self._waiting and self._waiting[-1][0] == key:
                self._waiting.pop()
            self._waiting.append((key, action))
            self._condition.notify_all()

    def wait(self, timeout_s: float = 60.0) -> bool:
        """Wait until nothing is left to do; return whether that happened in time."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._waiting and not self._busy, timeout_s)

    def close(self) -> None:
        """Do what waits, and end."""
        with self._condition:
            self._ended = True
            self._condition.notify_all()
        self._thread.join(10.0)

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting or self._ended)
                if not self._waiting:
                    return
                action = self._waiting.popleft()[1]
                self._busy = True
            try:
                action()
            except PgdmError as error:
                self._complain(str(error))
            except OSError as error:
                self._complain(f"{error.filename or ''} {error.strerror or error}".strip())
            except Exception as error:  # noqa: BLE001 a defect must not end the page with its pose
                _log.exception("the labeler could not do what a page asked for")
                self._complain(f"a defect of pgdm: {type(error).__name__}: {error}")
            with self._condition:
                self._busy = False
                self.done += 1
                self._condition.notify_all()
