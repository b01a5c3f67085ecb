"""What commands import before they work: those that need no simulator must not load it."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from fake_runs import end, make, train
from library_trees import make_checkout
from pgdm.library import import_tcdm

HEAVY = ("torch", "mujoco", "mlflow", "hydra", "scipy", "matplotlib", "trimesh")
# Command -> modules that it does not need; in an order in which later commands may load more.
NEEDLESS = {
    "": HEAVY,
    "--help": HEAVY,
    "--version": HEAVY,
    "eval --help": HEAVY,
    "view --help": HEAVY,
    "report --help": HEAVY,
    "dashboard --help": HEAVY,
    "tasks": HEAVY,
    "runs": HEAVY,
    "runs --json": HEAVY,
    "runs --help": HEAVY,
    "assets --help": HEAVY,
    "assets list": HEAVY,
    "assets verify": HEAVY,
    "sweep --help": HEAVY,
    "sweep status --help": HEAVY,
    "author --help": HEAVY,
    "author list": HEAVY,
    "author remove nothing": HEAVY,
    "pregrasp --help": HEAVY,
    "pregrasp reach --help": HEAVY,
    "report runs": ("torch", "mujoco", "mlflow", "scipy", "trimesh"),
}
PROGRAM = """
import contextlib, io, json, sys
from pgdm.cli.main import main
needless, found = json.loads(sys.argv[1]), {}
for command, modules in needless.items():
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        main(command.split())
    found[command] = [module for module in modules if module in sys.modules]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the needless modules that are there after each command, all in one process."""
    place = tmp_path_factory.mktemp("startup")
    run = make(place / "runs" / "hammer-use1")
    train(run)
    end(run)
    import_tcdm(make_checkout(place / "TCDM", ("hammer_use1",)), place / "home" / "library")
    env = {"PGDM_HOME": str(place / "home"), "PGDM_USER_DIR": str(place / "user")}
    command = [sys.executable, "-c", PROGRAM, json.dumps(NEEDLESS)]
    done = subprocess.run(
        command, cwd=place, env=os.environ | env, capture_output=True, text=True, check=True
    )
    assert (place / "runs/report/report.html").is_file()  # the last command did its work
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", NEEDLESS)
def test_a_command_loads_only_what_it_needs(loaded: dict[str, list[str]], command: str) -> None:
    assert loaded[command] == []


def test_import_pgdm_is_light() -> None:
    code = f"import sys, pgdm; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# Command -> what is wrong with it; none of them may load torch or the simulator to say so.
WRONG = {
    "pgdm-run task=hamer-use1": "did you mean hammer-use1",
    "pgdm-run seed=x": "seed: 'x' is not an integer",
    "pgdm-run algo=sac algo.batch_size=x": "algo.batch_size: 'x' is not an integer",
    "pgdm-run eval.video=maybe": "eval.video: 'maybe' is not true or false",
    "pgdm-run num_envs=0": "num_envs is 0; it must be at least 1",
    "pgdm-run algo.gamma=2": "algo.gamma is 2.0; it must be between 0 and 1",
    "pgdm-run algo.hidden=[0]": "every width must be at least 1",
    "pgdm-run -m seed=0,x": "seed: 'x' is not an integer",
    "pgdm-run run_dir=file": "'file' is a file",
    "pgdm-run run_dir=runs": "'runs' is not empty and holds no run",
    "pgdm view hamer": "did you mean hammer-use1",
    "pgdm view tcdm50": "tcdm50 is a suite of 50 tasks",
    "pgdm view hammer-use1 --hand adriot": "did you mean adroit",
    "pgdm view hammer-use1 --pregrasp planed": "did you mean planned",
    "pgdm view hammer-use1 --video a.avi": "--video 'a.avi' is not an MP4",
    "pgdm view hammer-use1 --ablations --image a.jpg": "--image 'a.jpg' is not a PNG",
    "pgdm eval nothing": "no run folder or checkpoint 'nothing'",
    "pgdm resume nothing": "no run folder or checkpoint 'nothing'",
    "pgdm pregrasp check hamer": "did you mean hammer-use1",
    "pgdm pregrasp check a.npz": "there is no file or folder 'a.npz'",
    "pgdm pregrasp check hammer-use1 --source mind": "did you mean mined",
    "pgdm pregrasp reach hamer": "did you mean hammer-use1",
    "pgdm pregrasp reach hammer-use1 --source planned": "unknown --source 'planned'",
    "pgdm pregrasp show hamer": "did you mean hammer-use1",
    "pgdm pregrasp label hamer": "did you mean hammer-use1",
    "pgdm pregrasp mocap hamer": "did you mean hammer-use1",
    "pgdm pregrasp mocap hammer-use1 --file a.csv": "there is no file or folder 'a.csv'",
    "pgdm pregrasp teleop door-open a.pickle": "there is no file or folder 'a.pickle'",
    "pgdm pregrasp predict hamer": "did you mean hammer-use1",
    "pgdm pregrasp predict hammer-use1 --weights a.npz": "there is no file or folder 'a.npz'",
    "pgdm pregrasp train --hand adriot": "did you mean adroit",
    "pgdm author object a.stl --name a": "there is no file or folder 'a.stl'",
    "pgdm author object file --name A": "object name 'A' is not valid",
    "pgdm author task --object hammer --id hammer-use1": "'hammer-use1' is taken",
    "pgdm author task --object hamer --id hamer-lift": "did you mean hammer",
    "pgdm report nothing": "there is no folder 'nothing'",
}
_MISTAKES = """
import contextlib, io, json, shlex, sys
from pgdm.cli import main, run
found = {}
for command in json.loads(sys.argv[1]):
    name, *arguments = shlex.split(command)
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        code = {"pgdm": main, "pgdm-run": run}[name].main(arguments)
    loaded = [module for module in ("torch", "mujoco") if module in sys.modules]
    found[command] = code, err.getvalue(), loaded
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, list[str]]]:
    """Return exit code, stderr and loaded modules of each wrong command, all in one process."""
    place = tmp_path_factory.mktemp("wrong")
    make(place / "runs" / "hammer-use1")
    (place / "file").touch()
    import_tcdm(make_checkout(place / "TCDM", ("hammer_use1",)), place / "home" / "library")
    env = {"PGDM_HOME": str(place / "home"), "PGDM_USER_DIR": str(place / "user")}
    command = [sys.executable, "-c", _MISTAKES, json.dumps(list(WRONG))]
    done = subprocess.run(
        command, cwd=place, env=os.environ | env, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", WRONG)
def test_a_mistake_is_reported_before_anything_slow_loads(
    answers: dict[str, tuple[int, str, list[str]]], command: str
) -> None:
    code, err, loaded = answers[command]
    assert code in (1, 2) and loaded == []
    assert len(err.splitlines()) == 1 and err.startswith("error: ") and WRONG[command] in err


def test_the_package_runs_as_a_module_and_h_is_help() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pgdm", "runs", "list", "-h"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("Usage: pgdm runs list ")


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("pgdm view hammer-s", ["hammer-strike"]),
        ("pgdm pregrasp reach tcdm", ["tcdm30", "tcdm50"]),
        ("pgdm view hammer-use1 --hand d", ["dhand", "dmanus"]),
        ("pgdm view hammer-use1 --pregrasp pl", ["planned"]),
        ("pgdm-run task=hammer-s", ["task=hammer-strike"]),
    ],
)
def test_names_complete_in_the_shell(line: str, found: list[str]) -> None:
    name, *words = line.split()
    if name == "pgdm":
        own = {"_PGDM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words))}
        command = [sys.executable, "-m", "pgdm"]
    else:
        own = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        start = "import sys; from pgdm.cli.run import main; sys.exit(main())"
        command = [sys.executable, "-c", start, "-sc", "query=bash"]
    done = subprocess.run(
        command, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == found
