"""The states of jobs in Slurm; one query covers all of them."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass

from pgdm.errors import SweepError

GONE, UNKNOWN = "GONE", "UNKNOWN"
"""Two states besides Slurm's: Slurm has no such job (any more), or cannot be queried."""
_PENDING = ("PENDING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "RESV_DEL_HOLD", "SPECIAL_EXIT")
_ENDED = (
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY"),
    *("PREEMPTED", "REVOKED", "TIMEOUT", GONE),
)
# Beginnings of the reasons for which Slurm never starts a pending job.
_STUCK = (
    *("accountnotallowed", "badconstraints", "dependencyneversatisfied", "invalidaccount"),
    *("invalidqos", "jobholdmaxrequeue", "launch failed", "partitionnodelimit"),
    *("partitiontimelimit", "qosnotallowed"),
)
_QUERY = ("squeue", "--me", "--array", "--states=all", "--noheader")
_FIELDS = "--Format=JobArrayID:40,State:20,exit_code:12,Reason:80"
_ANSWER_S = 60.0
_AGAIN_S = 1.0


@dataclass(frozen=True)
class Standing:
    """The state of one of Slurm's jobs."""

    state: str
    """Slurm's name for the state, such as ``RUNNING``; or ``GONE``, ``UNKNOWN``."""
    status: int = 0
    """Exit status of its process, as ``wait`` returns it."""
    reason: str = ""
    """Why it waits, or has ended."""

    @property
    def alive(self) -> bool:
        """Whether it runs or will run; True if Slurm cannot be queried."""
        return self.state not in _ENDED

    @property
    def pending(self) -> bool:
        """Whether it waits to be started, for the first time or again."""
        return self.state in _PENDING

    @property
    def stuck(self) -> bool:
        """Whether Slurm will never start it."""
        return self.pending and self.reason.lower().replace("_", " ").startswith(_STUCK)

    @property
    def exit_code(self) -> int:
        """Exit code, or the negative number of the signal that killed it."""
        return self.status >> 8 or -(self.status & 0x7F)


class Queue:
    """The user's jobs in Slurm, cached for a short time.

    Args:
        interval_s: maximum age of a cached answer, s.
    """

    def __init__(self, interval_s: float = 10.0) -> None:
        self._interval_s = interval_s
        self._found: dict[str, Standing] | None = None
        self._asked_s = -math.inf
        self._answered_s = time.monotonic()

    def find(self, slurm_id: str) -> Standing:
        """Return the state of a job."""
        age_s = time.monotonic() - self._asked_s
        # A missing job may be newer than the answer.
        missing = self._found is not None and slurm_id not in self._found
        if age_s > self._interval_s or (missing and age_s > _AGAIN_S):
            self._ask()
        if self._found is None:
            return Standing(UNKNOWN)
        return self._found.get(slurm_id, Standing(GONE))

    def forget(self) -> None:
        """Make the next ``find`` ask Slurm again, since jobs were submitted."""
        self._asked_s = -math.inf

    @property
    def silent_s(self) -> float:
        """Time since Slurm's last answer, s; 0 if the last query was answered."""
        return 0.0 if self._found is not None else time.monotonic() - self._answered_s

    def _ask(self) -> None:
        try:
            self._found = parse(output([*_QUERY, _FIELDS]))
            self._answered_s = time.monotonic()
        except SweepError:
            self._found = None
        self._asked_s = time.monotonic()


def parse(text: str) -> dict[str, Standing]:
    """Parse the output of ``squeue`` into a mapping from Slurm job ID to state."""
    found = {}
    for line in filter(str.strip, text.splitlines()):
        slurm_id, state, status, *reason = line.split(None, 3)
        found[slurm_id] = Standing(state, int(status), "".join(reason).strip())
    return found


def cancel(slurm_ids: Iterable[str]) -> None:
    """Have Slurm cancel jobs: it signals them to save, and kills them after its ``KillWait``."""
    try:
        if ids := list(slurm_ids):
            output(["scancel", "--quiet", *ids])
    except SweepError as error:
        if "Invalid job id" not in str(error):  # such a job ended long ago
            raise


def requeue(slurm_id: str) -> None:
    """Have Slurm queue this job again, unless it is being cancelled.

    Called by the job itself, after it has saved because its time is up or it is preempted.
    """
    state = output(["squeue", "--noheader", "--jobs", slurm_id, "--format=%T"]).strip()
    if state in ("RUNNING", "SIGNALING"):
        output(["scontrol", "requeue", slurm_id])


def output(command: list[str]) -> str:
    """Run one of Slurm's commands, and return its output.

    Raises:
        SweepError: if the command is missing, fails or does not answer.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SweepError(f"{command[0]} does not answer ({error})") from error
    if done.returncode:
        raise SweepError(f"{command[0]} failed: {' '.join(done.stderr.split())}")
    return done.stdout
