from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys

from pgdm.sweep.processes import Process

SLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]


def test_a_process_is_alive_until_it_ends() -> None:
    with subprocess.Popen(SLEEP) as process:
        known = Process.of(process.pid)
        assert known.alive and known.here
        assert known.signal(signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not known.alive  # nobody has asked for its exit code yet
    assert not known.alive
    assert not known.signal(signal.SIGTERM)
    assert Process.of(process.pid).born == ""


def test_who_has_the_number_later_is_another_one() -> None:
    me = Process.of(os.getpid())
    assert me.alive
    assert not dataclasses.replace(me, born=me.born + "1").alive
    assert not dataclasses.replace(me, born="").alive
    assert not dataclasses.replace(me, host="elsewhere").alive
