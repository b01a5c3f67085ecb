"""README.md holds: every command in it is run, here or by ``.ci/run``."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
CI = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")

PYTHON_BIN = Path(sys.executable).parent
# `make` with the environment that runs this test, taken as complete.
MAKE_RUN = f"make run VENV={sys.prefix} --assume-old={sys.prefix}/.run"

# Run by .ci/run on every change, as they stand.
BY_CI = ("make test", "make check", "make docs", "make slow")

# Run here as they stand; each needs seconds.
QUICK = (
    "pgdm-run --help",
    "pgdm tasks",
    "pgdm assets list",
    "pgdm assets show cup-pour1",
    "pgdm pregrasp show hammer-use1",
    "pgdm-run task=cup-pour1 method=deepmimic --dry-run",
    "pgdm view cup-pour1 --ablations --image starts.png",
    "pgdm-run -m task=tcdm30 seed=0,1,2 --dry-run",
    "pgdm-run +sweep=validate_tcdm50 budget=smoke --dry-run",
)

# Run here, in this order and in one folder, with a smaller budget: command -> what is run.
CUP = "pgdm-run +experiment=fast task=cup-pour1"
SMALL = "total_frames=8192 eval.episodes=2"
WALK = {
    "make run": f'{MAKE_RUN} ARGS="{SMALL} tracking=none run_dir=$PWD/runs/quickstart"',
    f"{CUP} run_dir=runs/cup": f"{CUP} {SMALL} run_dir=runs/cup",
    "pgdm eval runs/cup --video": "pgdm eval runs/cup --video --episodes 2",
    "pgdm runs": "pgdm runs",
    "pgdm view cup-pour1 --video cup.mp4": "pgdm view cup-pour1 --video cup.mp4",
    "pgdm-run -m task=cup-pour1,duck-lift seed=0,1,2 total_frames=1_000_000 sweep.name=lifts": (
        "pgdm-run -m task=cup-pour1,duck-lift seed=0,1,2 total_frames=4096 eval.episodes=1 "
        "eval.video=false tracking=none sweep.name=lifts"
    ),
    "pgdm sweep status runs/sweeps/lifts": "pgdm sweep status runs/sweeps/lifts",
    "pgdm report runs/sweeps/lifts": "pgdm report runs/sweeps/lifts",
}

# Each has a test of its own below.
OWN = ("apt-get install", "make setup", ". .venv/bin/activate", "pgdm dashboard")


def blocks(language: str) -> list[str]:
    """Return the README's code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Return the README's shell commands, in order."""
    lines = "\n".join(blocks("sh")).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def shell(command: str, cwd: Path) -> str:
    """Run a command as a person in the activated environment would; return what it printed."""
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=cwd,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


def environment() -> dict[str, str]:
    """Return this process's environment with the programs of its Python first."""
    outside = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return outside | {"PATH": f"{PYTHON_BIN}{os.pathsep}{os.environ['PATH']}"}


def test_the_first_two_commands() -> None:
    assert blocks("sh")[0].split("\n")[:2] == ["make run", "make test"]


def test_every_command_is_covered() -> None:
    covered = {*BY_CI, *QUICK, *WALK}
    open_ones = [c for c in commands() if c not in covered and not c.startswith(OWN)]
    assert open_ones == [], "give each a place in tests/test_readme.py"
    stale = [c for c in covered if c not in commands()]
    assert stale == [], "README.md no longer has these"


def test_readme_is_short_and_its_results_are_those_of_the_page() -> None:
    assert len(README.splitlines()) <= 150
    section = README.split("## What is reproduced\n")[1].split("\n## ")[0]
    page = (REPOSITORY / "docs" / "results.md").read_text(encoding="utf-8")
    number = r"\d[\d,.]*\d|\d"
    assert set(re.findall(number, section)) - set(re.findall(number, page)) == set()


@pytest.mark.parametrize("command", BY_CI)
def test_ci_runs(command: str) -> None:
    assert re.search(rf"^{command}\b", CI, re.MULTILINE)
    shell(f"make -n {command.removeprefix('make ')}", REPOSITORY)


def test_ci_installs_the_packages_that_readme_names() -> None:
    (line,) = [c for c in commands() if c.startswith("apt-get install")]
    names = [word for word in line.split()[2:] if not word.startswith("-")]
    assert [name for name in names if not re.search(rf"\b{name}\b", CI)] == []


def test_setup_and_activation() -> None:
    prefix = sys.prefix
    shell(f"make setup VENV={prefix} --assume-old={prefix}/.run", REPOSITORY)
    activate = Path(prefix) / "bin" / "activate"
    found = shell(f". {activate} && command -v pgdm-run pgdm", REPOSITORY)
    assert found.split() == [f"{prefix}/bin/pgdm-run", f"{prefix}/bin/pgdm"]


@pytest.mark.parametrize("command", QUICK)
def test_quick_command(command: str, library_home: Path, tmp_path: Path) -> None:
    assert shell(command, tmp_path).strip()


def test_python_blocks(library_home: Path) -> None:
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), {"__name__": "readme"})


def test_links_lead_somewhere() -> None:
    targets = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert [t for t in targets if not (REPOSITORY / t).exists()] == []


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory, library_home: Path) -> tuple[Path, dict]:
    """Return the folder in which WALK was run, and what each command printed."""
    folder = tmp_path_factory.mktemp("walk")
    printed = {}
    for command, smaller in WALK.items():
        in_repository = smaller.startswith("make")
        smaller = smaller.replace("$PWD", str(folder))
        printed[command] = shell(smaller, REPOSITORY if in_repository else folder)
    return folder, printed


@pytest.mark.slow
def test_make_run_ends_with_a_result_and_a_video(walked: tuple[Path, dict]) -> None:
    folder, printed = walked
    text = printed["make run"]
    assert "success" in text
    (video,) = (folder / "runs" / "quickstart" / "videos").glob("*.mp4")
    assert video.name in text.replace("\n", "")
    assert video.stat().st_size > 10_000


@pytest.mark.slow
def test_the_walk_leaves_what_readme_says(walked: tuple[Path, dict]) -> None:
    folder, printed = walked
    assert "cup" in printed["pgdm runs"]
    assert (folder / "cup.mp4").stat().st_size > 10_000
    assert len(list((folder / "runs" / "sweeps").glob("*/runs/*/result.json"))) == 6


@pytest.fixture
def dashboard(walked: tuple[Path, dict]) -> Iterator[subprocess.Popen[str]]:
    """Start ``pgdm dashboard`` in the folder of the walk, and stop it afterwards."""
    process = subprocess.Popen(
        ["pgdm", "dashboard", "--port", "5123"],
        cwd=walked[0],
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    yield process
    os.killpg(process.pid, signal.SIGTERM)
    process.communicate(timeout=30)


@pytest.mark.slow
def test_dashboard_answers(dashboard: subprocess.Popen[str]) -> None:
    last: OSError | None = None
    for _ in range(120):
        assert dashboard.poll() is None, dashboard.communicate()[0]
        try:
            with urllib.request.urlopen("http://127.0.0.1:5123", timeout=5) as page:
                assert page.status == 200
                return
        except OSError as error:  # it is still starting
            last = error
            time.sleep(0.5)
    pytest.fail(f"the dashboard did not answer: {last}")
