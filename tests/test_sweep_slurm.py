"""Sweeps on a real Slurm, whose two nodes are this machine."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import slurm_cluster
from command_line import TINY, TINY_SAC, command, process
from pgdm.config.compose import compose
from pgdm.rl.checkpoint import CheckpointFolder
from pgdm.runs.files import read_json
from pgdm.runs.log import RunLog
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.plan import Job, Plan, job_key, write_plan
from pgdm.sweep.queue import parse
from pgdm.sweep.status import log_path, parent, rows
from slurm_cluster import NODES, output
from sweep_plans import SLURM, broken, plan, start
from test_rl_resume import flat

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not slurm_cluster.available(), reason="needs the packages slurmctld, slurmd, slurm-client"
    ),
]
JOBS = 12
Status = dict[str, Any]
"""Jobs by name, as printed by ``pgdm sweep status --json``."""
Driver = subprocess.Popen[str]
LONG = ("eval.interval_frames=0", "checkpoint.interval_s=0.5")
STEP = 16  # frames of an iteration


@pytest.fixture(scope="module")
def _slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("slurm")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        with slurm_cluster.slurm(folder):
            yield


@pytest.fixture
def folder(_slurm: None, library_home: Path, tmp_path: Path) -> Path:
    return tmp_path / "sweep"


@pytest.fixture
def drive(folder: Path, tmp_path: Path) -> Iterator[Callable[[Plan], Driver]]:
    """Return what starts a sweep; its output goes to ``driver.txt``."""
    drivers: list[Driver] = []
    with open(tmp_path / "driver.txt", "a") as log:

        def begin(whole: Plan) -> Driver:
            write_plan(whole)
            Ledger(folder).add(whole)
            drivers.append(start(folder, log, "SLURM"))
            return drivers[-1]

        yield begin
        for driver in drivers:
            driver.kill()
            driver.wait()


def standings() -> dict[str, str]:
    fields = "--Format=JobArrayID:40,State:20,exit_code:12,Reason:80"
    text = output("squeue", "--me", "--array", "--states=all", "--noheader", fields)
    found = parse(text)
    for slurm_id, standing in found.items():
        if standing.reason == "BeginTime":  # what is queued again would wait for two minutes
            output("scontrol", "update", f"jobid={slurm_id}", "StartTime=now")
    return {slurm_id: standing.state for slurm_id, standing in found.items()}


def observe(folder: Path) -> Status:
    """Return the jobs of ``pgdm sweep status``, after comparing them with Slurm's."""
    before = standings()
    status = json.loads(command("pgdm", "sweep", "status", str(folder), "--json").out)
    after = standings()
    steady = {i: state for i, state in before.items() if after.get(i) == state}
    held = {}
    for job in status["jobs"]:
        if job["slurm"] is not None:
            slurm_id, state = job["slurm"].split()[:2]
            held[slurm_id] = job["state"]
            assert state in (steady.get(slurm_id, state), "SIGNALING")  # for a moment
    ours = {i for i, state in steady.items() if state in ("RUNNING", "PENDING")} - OTHERS
    assert ours <= set(held)
    for slurm_id in ours:
        shown = {"RUNNING": ("running",), "PENDING": ("waiting",)}[steady[slurm_id]]
        assert held[slurm_id] in (*shown, "cancelled")
    running = [i for i in ours if steady[i] == "RUNNING"]
    assert len(running) <= SLURM.array_parallelism
    return {job["name"]: job for job in status["jobs"]}


OTHERS: set[str] = set()
"""Jobs in Slurm that are none of the sweep."""


def until(
    condition: Callable[[Status], object],
    folder: Path,
    driver: Driver | None = None,
) -> Status:
    limit = time.monotonic() + 400
    while True:
        found = observe(folder)
        if condition(found):
            return found
        assert driver is None or driver.poll() is None, Path("driver.txt").read_text()
        assert time.monotonic() < limit, found
        time.sleep(0.5)


def on_node(node: str, folder: Path) -> dict[str, str]:
    """Return the jobs of a sweep that run on a node: name to Slurm's id."""
    text = output(
        "squeue", "--noheader", "--array", "--states=R", f"-w{node}", "--Format=JobArrayID:40"
    )
    ids = {e.last.slurm_id: e.name for e in Ledger(folder).entries() if e.last is not None}
    return {ids[i]: i for i in text.split() if i in ids}


def restarts(slurm_id: str) -> int:
    return int(output("scontrol", "show", "job", slurm_id).split("Restarts=")[1].split()[0])


def held(node: str, folder: Path, driver: Driver | None, count: int = JOBS) -> dict[str, str]:
    """Stop jobs of a node in the middle of their work; Slurm's next signal lets them continue.

    Returns:
        Slurm's id of each by its name; one at least, and at most ``count``.
    """
    while True:
        found = until(
            lambda found: any(found[n]["frames"] for n in on_node(node, folder)), folder, driver
        )
        last = {e.name: e.last for e in Ledger(folder).entries() if e.last}
        stopped: dict[str, str] = {}
        for name, slurm_id in on_node(node, folder).items():
            if len(stopped) == count or not found[name]["frames"]:
                continue
            last[name].process.signal(signal.SIGSTOP)
            # Only now it is certain how far it has come: who is nearly done would just end.
            lines = RunLog(folder / "runs" / f"s{name.partition('=')[2]}" / "metrics.jsonl").read()
            if lines and lines[-1]["frames"] < 0.7 * found[name]["total_frames"]:
                stopped[name] = slurm_id
            else:
                last[name].process.signal(signal.SIGCONT)
        if stopped:
            return stopped


def preempt(node: str, folder: Path, driver: Driver) -> None:
    """Submit a job of higher priority that needs all of a node, and wait until it is done."""
    other = output(
        *("sbatch", "--parsable", "--partition=hi", f"--nodelist={node}", "--exclusive"),
        *("--output=/dev/null", "--wrap=sleep 4"),
    ).strip()
    OTHERS.add(other)
    until(lambda _: standings()[other] == "COMPLETED", folder, driver)


def test_whatever_slurm_does_each_job_is_done_once(
    folder: Path, drive: Callable[[Plan], Driver]
) -> None:
    whole = plan(folder, JOBS, *LONG, "total_frames=2000")
    driver = drive(whole)
    ledger = Ledger(folder)

    # A user cancels a job.
    ((name, ended),) = held("n1", folder, driver, 1).items()
    output("scancel", ended)
    until(lambda found: "CANCELLED" in (found[name]["error"] or ""), folder, driver)

    # The time of one is up.
    late = held("n2", folder, driver, 1)
    ((name, slurm_id),) = late.items()
    since = output("squeue", "--noheader", "--array", f"--jobs={slurm_id}", "--Format=TimeUsed:20")
    minutes = int(since.strip().split(":")[-2]) + 2
    output("scontrol", "update", f"jobid={slurm_id}", f"TimeLimit={minutes}")

    # Somebody else's jobs come first.
    preempted = held("n1", folder, driver)
    preempt("n1", folder, driver)
    until(lambda _: restarts(late[name]), folder, driver)
    output("scontrol", "update", f"jobid={late[name]}", "TimeLimit=60")

    # The driver is killed; then a node fails.
    driver.kill()
    driver.wait()
    lost = held("n2", folder, None)
    output("scontrol", "update", "nodename=n2", "state=down", "reason=test")
    until(lambda _: not on_node("n2", folder), folder)
    driver = drive(whole)
    until(lambda _: parent(ledger), folder, driver)
    output("scontrol", "update", "nodename=n2", "state=resume")
    until(lambda _: driver.poll() is not None, folder)
    assert driver.returncode == 0, Path("driver.txt").read_text()

    done = {row.name: row for row in rows(ledger)}
    assert {row.state for row in done.values()} == {"finished"}
    attempts = ledger.attempts()
    assert sorted(a.key for a in attempts if a.state == "finished") == sorted(ledger.states())
    failed = [attempt for attempt in attempts if attempt.state == "failed"]
    status = [(a.slurm_id, a.state, a.exit_code, a.error) for a in attempts]
    assert [attempt.slurm_id for attempt in failed] == [ended], status
    assert failed[0].error is not None and "CANCELLED" in failed[0].error
    # Slurm may refuse to queue a saved job again while it stops it; the sweep then starts it anew.
    displaced = [attempt for attempt in attempts if attempt.state == "interrupted"]
    assert {attempt.exit_code for attempt in displaced} <= {130, 143}, status
    arrays = Counter((a.slurm_id or "").partition("_")[0] for a in attempts)
    assert max(arrays.values()) == JOBS  # one array, and what was tried again
    assert len(attempts) == JOBS + len(failed) + len(displaced)
    for some in (late, preempted, lost):
        assert any(restarts(slurm_id) for slurm_id in some.values())
    assert "SIGUSR2: saving" in log_path(folder, name, 1).read_text()
    assert any("SIGTERM: saving" in log_path(folder, n, 1).read_text() for n in preempted)
    for seed, job in enumerate(whole.jobs):
        run = folder / "runs" / f"s{seed}"
        lines = RunLog(run / "metrics.jsonl").read()
        trained = [line["frames"] for line in lines if line["kind"] == "train"]
        assert trained == list(range(STEP, job.cfg.total_frames + 1, STEP))
        assert read_json(run / "result.json")["status"] == "finished"


def test_a_preempted_job_goes_on_with_its_replay(
    folder: Path, drive: Callable[[Plan], Driver], tmp_path: Path
) -> None:
    settings = (*TINY_SAC, *LONG, "offline=true", "seed=0", "total_frames=1280")
    cfg = compose([*settings, f"run_dir={folder / 'runs' / 's0'}"])
    job = Job(job_key(cfg), "seed=0", settings, cfg)
    driver = drive(Plan(folder.name, folder, (job,), "pgdm-run -m seed=0"))
    until(lambda _: any(on_node(node, folder) for node in NODES), folder, driver)
    (node,) = (node for node in NODES if on_node(node, folder))
    slurm_id = held(node, folder, driver)["seed=0"]
    preempt(node, folder, driver)
    until(lambda _: driver.poll() is not None, folder)
    assert driver.returncode == 0, Path("driver.txt").read_text()
    assert restarts(slurm_id) == 1
    log = log_path(folder, "seed=0", 1).read_text()
    assert "SIGTERM: saving" in log and "resuming" in log
    assert command("pgdm-run", *settings, "run_dir=straight").code == 0
    learners = [
        flat((CheckpointFolder(run / "checkpoints", 2).latest() or {})["learner"])
        for run in (folder / "runs" / "s0", tmp_path / "straight")
    ]
    assert learners[0] == learners[1]


def test_a_failed_job_ctrl_c_and_cancel(folder: Path, drive: Callable[[Plan], Driver]) -> None:
    whole = broken(plan(folder, 2, *LONG, "total_frames=16000"), 1)
    driver = drive(whole)
    ledger = Ledger(folder)
    until(
        lambda found: found["seed=1"]["state"] == "failed" and found["seed=0"]["frames"],
        folder,
        driver,
    )
    failed = [a for a in ledger.attempts() if a.key == whole.jobs[1].key]
    assert [(a.state, a.exit_code) for a in failed] == [("failed", 2)] * 2  # a name that is unknown
    assert all("no-such-motion" in (a.error or "") for a in failed)
    assert {standings()[a.slurm_id or ""] for a in failed} == {"FAILED"}

    driver.send_signal(signal.SIGINT)
    assert driver.wait(30) == 130
    assert "the jobs continue without this process" in Path("driver.txt").read_text()
    found = observe(folder)
    assert found["seed=0"]["state"] == "running"
    assert command("pgdm", "sweep", "cancel", str(folder)).code == 0
    found = until(lambda found: found["seed=0"]["slurm"] is None, folder)
    assert found["seed=0"]["state"] == "cancelled"
    result = read_json(folder / "runs" / "s0" / "result.json")
    assert (result["status"], result["frames"]) == ("interrupted", found["seed=0"]["frames"])
    assert standings()[ledger.attempts()[0].slurm_id or ""] in ("CANCELLED", "COMPLETED")
    assert "SIGTERM" in command("pgdm", "sweep", "logs", str(folder), "seed=0").out


def test_slurm_refuses(folder: Path) -> None:
    settings = ("--offline", "-m", "seed=0,1", *TINY, f"sweep.dir={folder}")
    outcome = process("pgdm-run", *settings, "hydra/launcher=slurm", "hydra.launcher.partition=gpu")
    assert outcome.code == 1
    (error,) = outcome.errors
    assert "Slurm refused the jobs: " in error and "invalid partition" in error
    assert {row.state for row in rows(Ledger(folder))} == {"waiting"}
