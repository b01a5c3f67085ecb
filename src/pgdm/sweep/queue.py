"""What Slurm says of its jobs; every question is asked for all of them at once."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass

from pgdm.errors import SweepError

GONE, UNKNOWN = "GONE", "UNKNOWN"
"""Not Slurm's words: it has no such job (any more), or cannot be asked."""
_PENDING = ("PENDING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "RESV_DEL_HOLD", "SPECIAL_EXIT")
_ENDED = (
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY"),
    *("PREEMPTED", "REVOKED", "TIMEOUT", GONE),
)
_STUCK = (
    *("accountnotallowed", "badconstraints", "dependencyneversatisfied", "invalidaccount"),
    *("invalidqos", "jobholdmaxrequeue", "launch failed", "partitionnodelimit"),
    *("partitiontimelimit", "qosnotallowed"),
)
_QUESTION = ("squeue", "--me", "--array", "--states=all", "--noheader")
_FIELDS = "--Format=JobArrayID:40,State:20,exit_code:12,Reason:80"
_ANSWER_S = 60.0
_AGAIN_S = 1.0


@dataclass(frozen=True)
class Standing:
    """Where one of Slurm's jobs stands."""

    state: str
    """Slurm's word, such as ``RUNNING``; or ``GONE``, ``UNKNOWN``."""
    status: int = 0
    """How its process ended, as ``wait`` tells it."""
    reason: str = ""
    """Why it waits, or ended."""

    @property
    def alive(self) -> bool:
        """Whether it runs or will run; so is what cannot be asked."""
        return self.state not in _ENDED

    @property
    def pending(self) -> bool:
        """Whether it waits for its start, the first or another one."""
        return self.state in _PENDING

    @property
    def stuck(self) -> bool:
        """Whether Slurm will never start it, as it is."""
        return self.pending and self.reason.lower().replace("_", " ").startswith(_STUCK)

    @property
    def exit_code(self) -> int:
        """Exit code, or minus the signal that ended it."""
        return self.status >> 8 or -(self.status & 0x7F)


class Queue:
    """The user's jobs in Slurm, as they were a moment ago.

    Args:
        interval_s: how old an answer may be, s.
    """

    def __init__(self, interval_s: float = 10.0) -> None:
        self._interval_s = interval_s
        self._found: dict[str, Standing] | None = None
        self._asked_s = -math.inf
        self._answered_s = time.monotonic()

    def find(self, slurm_id: str) -> Standing:
        """Return where a job stands."""
        age_s = time.monotonic() - self._asked_s
        # What is missing may be newer than the answer.
        missing = self._found is not None and slurm_id not in self._found
        if age_s > self._interval_s or (missing and age_s > _AGAIN_S):
            self._ask()
        if self._found is None:
            return Standing(UNKNOWN)
        return self._found.get(slurm_id, Standing(GONE))

    def forget(self) -> None:
        """Ask anew when next asked: something has changed."""
        self._asked_s = -math.inf

    @property
    def silent_s(self) -> float:
        """For how long Slurm has not answered, s."""
        return 0.0 if self._found is not None else time.monotonic() - self._answered_s

    def _ask(self) -> None:
        try:
            self._found = parse(told([*_QUESTION, _FIELDS]))
            self._answered_s = time.monotonic()
        except SweepError:
            self._found = None
        self._asked_s = time.monotonic()


def parse(text: str) -> dict[str, Standing]:
    """Return what ``squeue`` printed, by Slurm's id of each job."""
    found = {}
    for line in text.splitlines():
        slurm_id, state, status, reason = line.split(None, 3)
        found[slurm_id] = Standing(state, int(status), reason.strip())
    return found


def cancel(slurm_ids: Iterable[str]) -> None:
    """Have Slurm end jobs: a signal to save, then, after its ``KillWait``, the end."""
    try:
        if ids := list(slurm_ids):
            told(["scancel", "--quiet", *ids])
    except SweepError as error:
        if "Invalid job id" not in str(error):  # what has ended long ago
            raise


def requeue(slurm_id: str) -> None:
    """Have Slurm start this job once more, unless it is ending it for good.

    Asked from inside the job, which has saved because its time is up or its node is wanted.
    """
    state = told(["squeue", "--noheader", "--jobs", slurm_id, "--format=%T"]).strip()
    if state in ("RUNNING", "SIGNALING"):
        told(["scontrol", "requeue", slurm_id])


def told(command: list[str]) -> str:
    """Run one of Slurm's commands, and return what it prints.

    Raises:
        SweepError: if it is missing, fails or does not answer.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SweepError(f"{command[0]} does not answer ({error})") from error
    if done.returncode:
        raise SweepError(f"{command[0]} failed: {' '.join(done.stderr.split())}")
    return done.stdout
