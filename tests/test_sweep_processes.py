from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from pgdm.sweep.processes import Process

SLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]


def test_a_process_is_alive_until_it_ends() -> None:
    with subprocess.Popen(SLEEP) as process:
        known = Process.of(process.pid)
        assert known.alive and known.here
        assert known.signal(signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not known.alive  # its exit code has not been read yet
    assert not known.alive
    assert not known.signal(signal.SIGTERM)
    assert Process.of(process.pid).born == ""


def test_a_process_whose_first_thread_ended_is_alive() -> None:
    code = (
        "import ctypes, threading, time; threading.Thread(target=time.sleep, args=(60,)).start(); "
        "print(flush=True); ctypes.CDLL(None).syscall(ctypes.c_long(SYS_EXIT), 0)"
    ).replace("SYS_EXIT", {"x86_64": "60"}.get(os.uname().machine, "93"))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        known = Process.of(process.pid)
        assert process.stdout is not None
        process.stdout.readline()
        stat = Path(f"/proc/{process.pid}/stat")
        while stat.read_text().rpartition(")")[2].split()[0] != "Z":
            time.sleep(0.01)
        assert known.alive
        process.kill()
        process.wait()
    assert not known.alive


def test_who_has_the_number_later_is_another_one() -> None:
    me = Process.of(os.getpid())
    assert me.alive
    assert not dataclasses.replace(me, born=me.born + "1").alive
    assert not dataclasses.replace(me, born="").alive
    assert not dataclasses.replace(me, host="elsewhere").alive
