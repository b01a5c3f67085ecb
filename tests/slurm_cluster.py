"""A real Slurm of two nodes on this one machine, without accounts: for tests only."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

NODES = ("n1", "n2")
CORES = 2
"""Of each node, as it claims."""

# auth/none believes everybody, and needs no daemon for it.
_CONF = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
SlurmctldPort={ports[0]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/log/slurmctld.log
SlurmdLogFile={folder}/log/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SchedulerParameters=batch_sched_delay=0,sched_interval=2,bf_interval=2
KillWait=10
MpiDefault=none
MailProg=/bin/true
ReturnToService=1
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs={cores} RealMemory=8000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs={cores} RealMemory=8000
PartitionName=main Nodes=ALL Default=YES PriorityTier=1 PreemptMode=REQUEUE GraceTime=20
PartitionName=hi Nodes=ALL PriorityTier=10 PreemptMode=OFF
"""


def available() -> bool:
    """Return whether Slurm's daemons are installed."""
    return shutil.which("slurmctld") is not None and shutil.which("slurmd") is not None


@contextlib.contextmanager
def slurm(folder: Path) -> Iterator[None]:
    """Run a Slurm that keeps everything in a folder; ``SLURM_CONF`` must name its slurm.conf."""
    for name in ("state", "spool", "log"):
        (folder / name).mkdir(parents=True)
    host, user = socket.gethostname().split(".")[0], os.environ.get("USER", "root")
    text = _CONF.format(host=host, user=user, folder=folder, ports=_free_ports(3), cores=CORES)
    (folder / "slurm.conf").write_text(text)
    try:
        output("slurmctld", "-c")
        for node in NODES:
            output("slurmd", "-N", node)
        limit = time.monotonic() + 30
        while output("sinfo", "--noheader", "--format=%T", "--partition=main").split() != ["idle"]:
            assert time.monotonic() < limit, (folder / "log" / "slurmctld.log").read_text()
            time.sleep(0.2)
        yield
    finally:
        subprocess.run(["scancel", "--quiet", "--me"], check=False)
        limit = time.monotonic() + 20
        while output("squeue", "--noheader") and time.monotonic() < limit:
            time.sleep(0.2)
        for file in folder.glob("*.pid"):  # a node that is down would not hear scontrol shutdown
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(file.read_text()), signal.SIGKILL)


def output(*command: str) -> str:
    """Run one of Slurm's commands, and return what it prints."""
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
