"""A queue of actions from all pages, run one after the other by a single thread."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Hashable

from pgdm.errors import PgdmError

_log = logging.getLogger(__name__)

Action = Callable[[], None]


class Mailbox:
    """Runs actions posted by any thread, in order, on a thread of its own.

    Of consecutive waiting actions with the same key (other than None), only the last runs. So the
    updates of a drag do not pile up if they come faster than they can be computed.

    Args:
        complain: receives the error message if an action fails.
    """

    def __init__(self, complain: Callable[[str], None]) -> None:
        self._complain = complain
        self._waiting: deque[tuple[Hashable, Action]] = deque()
        self._condition = threading.Condition()
        self._busy = self._ended = False
        self._thread = threading.Thread(target=self._run, name="labeler", daemon=True)
        self._thread.start()

    def post(self, action: Action, key: Hashable = None) -> None:
        """Queue an action; with a key, it replaces the last waiting action of the same key."""
        with self._condition:
            if key is not None and self._waiting and self._waiting[-1][0] == key:
                self._waiting.pop()
            self._waiting.append((key, action))
            self._condition.notify_all()

    def wait(self, timeout_s: float = 60.0) -> bool:
        """Wait until all actions have run; return False on timeout."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._waiting and not self._busy, timeout_s)

    def close(self) -> None:
        """Run the waiting actions, then stop the thread; wait for it at most 10 s."""
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
            except Exception as error:  # noqa: BLE001 a bug must not end the thread
                _log.exception("an action of the labeler failed")
                self._complain(f"bug in pgdm: {type(error).__name__}: {error}")
            with self._condition:
                self._busy = False
                self._condition.notify_all()
