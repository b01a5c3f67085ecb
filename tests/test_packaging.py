"""Packaging: declared dependencies, pinned versions, and a wheel that works on its own."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

REPOSITORY = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TINY_RUN = (
    "task=hammer-use1",
    "total_frames=8192",
    "num_envs=32",
    "tracking=none",
    "eval.episodes=2",
    "eval.video=false",
    "run_dir=out/tiny",
)


def requirements(*extras: str) -> dict[str, Requirement]:
    """Return the project's requirements by canonical name."""
    lines = list(PROJECT["dependencies"])
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    found = [Requirement(line) for line in lines]
    return {canonicalize_name(r.name): r for r in found if r.name != PROJECT["name"]}


def pins() -> dict[str, Version]:
    """Return the pinned versions of constraints.txt."""
    text = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pairs = [line.split("==") for line in lines]
    return {canonicalize_name(name): Version(version) for name, version in pairs}


def imported_packages() -> set[str]:
    """Return the top-level names of third-party packages that the source imports."""
    names: set[str] = set()
    for path in (REPOSITORY / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module)
    found = {name.split(".")[0] for name in names} - {"pgdm", "_typeshed"}  # the latter: for types
    return found - set(sys.stdlib_module_names)


# trimesh imports them to repair or simplify meshes, but declares neither.
THROUGH_TRIMESH = {"networkx", "fast-simplification"}


def test_imported_packages_are_declared_and_declared_ones_imported() -> None:
    declared, used = set(requirements()), set()
    optional = set(requirements("export", "gpu", "hardware", "sb3")) - declared
    distributions = metadata.packages_distributions()
    for name in sorted(imported_packages()):
        # Several distributions may share a top-level name, such as mlflow and mlflow-skinny.
        owners = {canonicalize_name(d) for d in distributions[name]}
        assert owners & (declared | optional), (
            f"{name} is imported, but none of {owners} is a dependency"
        )
        used |= owners
    used |= THROUGH_TRIMESH
    assert declared <= used, f"nothing imports {declared - used}"


def test_every_requirement_is_pinned_within_its_range() -> None:
    exact = pins()
    for name, requirement in requirements("docs", "export", "gpu", "sb3", "server", "dev").items():
        assert name in exact, f"{name} is missing in constraints.txt"
        assert requirement.specifier.contains(exact[name]), f"{requirement} excludes {exact[name]}"


@pytest.mark.skipif(
    Path(sys.prefix) != REPOSITORY / ".venv", reason="only for the environment that make creates"
)
def test_the_environment_has_exactly_the_pinned_versions() -> None:
    unpinned = {"setuptools", "wheel", "pgdm"}
    installed = {
        canonicalize_name(d.metadata["Name"]): Version(d.version).public
        for d in metadata.distributions()
    }
    expected = {name: version.public for name, version in pins().items()}
    assert {n: v for n, v in installed.items() if n not in unpinned} == expected


def test_the_pinned_versions_support_every_python_that_pgdm_supports() -> None:
    # Debian's python3.11 is 3.11.2, and some packages require a later patch release.
    oldest = PROJECT["requires-python"].removeprefix(">=")
    exact = pins()
    for distribution in metadata.distributions():
        name, version = distribution.metadata["Name"], Version(distribution.version)
        needs = distribution.metadata.get("Requires-Python")
        if needs and exact.get(canonicalize_name(name)) == Version(version.public):
            assert SpecifierSet(needs).contains(f"{oldest}.2"), f"{name} needs Python {needs}"


def test_constraints_name_no_registry_and_no_local_path() -> None:
    text = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8")
    assert not re.search(r"https?:|file:|/|@|--", re.sub(r"(?m)^#.*", "", text))


def _run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command without this environment's Python variables, and return its output."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=clean | environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the sdist and the wheel built from it."""
    out = tmp_path_factory.mktemp("dist")
    _run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, cwd=REPOSITORY)
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    return sdist, wheel


@pytest.mark.slow
def test_settings_are_in_sdist_and_wheel(built: tuple[Path, Path]) -> None:
    files = [p for name in ("conf", "sweeps") for p in (REPOSITORY / name).rglob("*.yaml")]
    own = {p.relative_to(REPOSITORY) for p in files}
    with tarfile.open(built[0]) as archive:
        inner = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert own <= inner
    with zipfile.ZipFile(built[1]) as wheel:
        names = {Path(name) for name in wheel.namelist()}
    assert {Path("pgdm") / path for path in own} <= names
    assert Path("pgdm/conf/__init__.py") in names
    assert Path("pgdm/py.typed") in names
    beside = ("page.html", "page.css", "paper.yaml")
    assert {Path("pgdm/report") / name for name in beside} <= names


@pytest.mark.slow
def test_an_installed_wheel_works_outside_the_repository(
    built: tuple[Path, Path], library_home: Path, tmp_path: Path
) -> None:
    environment, elsewhere = tmp_path / "venv", tmp_path / "elsewhere"
    elsewhere.mkdir()
    _run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=elsewhere)
    programs = environment / "bin"
    # Its dependencies are taken from here, but not pgdm itself: a path in a .pth file does not add
    # the editable packages found there. `make run`, in tests/test_readme.py, installs them.
    (packages,) = (environment / "lib").glob("python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    pip = (programs / "python", "-m", "pip")
    _run(*pip, "install", "--quiet", "--no-deps", built[1], cwd=elsewhere)
    _run(*pip, "check", cwd=elsewhere)
    assert "pgdm-run" in _run(programs / "pgdm-run", "--help", cwd=elsewhere)
    assert "assets" in _run(programs / "pgdm", "--help", cwd=elsewhere)
    package = "import hydra, pgdm.conf; print(pgdm.conf.__file__)"
    where = _run(programs / "python", "-c", package, cwd=elsewhere)
    assert str(environment) in where
    plan = _run(programs / "pgdm-run", "+sweep=sim2real", "--dry-run", cwd=elsewhere)
    assert "dmanus-sim2real" in plan
    _run(programs / "pgdm-run", *TINY_RUN, cwd=elsewhere, PGDM_HOME=str(library_home))
    result = json.loads((elsewhere / "out/tiny/result.json").read_text(encoding="utf-8"))
    assert result["status"] == "finished"
    assert result["frames"] == 8192
