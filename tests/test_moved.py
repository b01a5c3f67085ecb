"""Old module names import the moved module and warn; nothing in the repository uses them."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pgdm.moved import MOVED

REPOSITORY = Path(__file__).resolve().parents[1]
NAMES = {f"pgdm.{old}": f"pgdm.{new}" for old, new in MOVED.items()}


@pytest.mark.parametrize(("old", "new"), NAMES.items())
def test_an_old_name_is_the_new_module_and_warns_once(
    old: str, new: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    current = importlib.import_module(new)
    spec = current.__spec__
    monkeypatch.delitem(sys.modules, old, raising=False)
    with pytest.warns(DeprecationWarning) as caught:
        assert importlib.import_module(old) is current
        assert importlib.import_module(old) is current  # the second import is silent
    assert [str(warning.message) for warning in caught] == [f"{old} is now {new}"]
    assert current.__spec__ is spec and current.__name__ == new


def test_classes_and_functions_of_old_names_are_the_same_objects() -> None:
    from pgdm.library.files.keyframes import Keyframe
    from pgdm.runs.folder import read_json

    space: dict[str, object] = {}
    for module in ("pgdm.library.animate", "pgdm.tracking.run_folder"):
        sys.modules.pop(module, None)
    code = (
        "from pgdm.library.animate import Keyframe\nfrom pgdm.tracking.run_folder import read_json"
    )
    with pytest.warns(DeprecationWarning) as caught:
        exec(compile(code, "users_script.py", "exec"), space)
    assert space["Keyframe"] is Keyframe and space["read_json"] is read_json
    assert {warning.filename for warning in caught} == {"users_script.py"}


def test_other_missing_modules_are_still_errors() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"pgdm\.library\.animated_cartoons"):
        importlib.import_module("pgdm.library.animated_cartoons")


def test_importing_pgdm_warns_of_nothing() -> None:
    command = [sys.executable, "-W", "error::DeprecationWarning", "-c", "import pgdm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def _imported(source: str) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


@pytest.mark.parametrize("folder", ["src", "tests", "benchmark", "tools"])
def test_no_code_imports_an_old_name(folder: str) -> None:
    used = {
        f"{path.relative_to(REPOSITORY)} uses {name}, which is now {NAMES[name]}"
        for path in (REPOSITORY / folder).rglob("*.py")
        for name in _imported(path.read_text(encoding="utf-8")) & NAMES.keys()
    }
    assert used == set()


def test_no_page_names_an_old_module() -> None:
    old = re.compile(rf"\b({'|'.join(map(re.escape, NAMES))})\b")
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")]
    used = {(page.name, name) for page in pages for name in old.findall(page.read_text())}
    assert used == set()
