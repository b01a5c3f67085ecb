"""The private interfaces of Hydra that pgdm uses: the installed version still has them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import hydra
import pytest
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from pgdm.config.compose import Composer
from pgdm.config.hydra_private import CHECKED_WITH, check_interfaces
from pgdm.errors import PgdmError

SOURCE = Path(__file__).resolve().parents[1] / "src" / "pgdm"


def test_the_installed_hydra_is_the_one_that_was_compared() -> None:
    # With another version: compare its ConfigLoaderImpl and defaults_list with hydra_private.py,
    # run test_sweep_expand.py, then change CHECKED_WITH.
    assert hydra.__version__ == CHECKED_WITH == "1.3.8"


def test_only_one_module_uses_private_interfaces() -> None:
    users = set()
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.startswith("hydra._internal") for name in names):
                users.add(path.name)
    assert users == {"hydra_private.py"}


def other(*arguments: object) -> None:
    del arguments


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (ConfigLoaderImpl, "_apply_overrides_to_config"),
        (defaults_list, "create_defaults_list"),
        (defaults_list, "_create_interpolation_map"),
    ],
)
def test_a_changed_interface_is_reported(
    owner: object, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_interfaces()
    monkeypatch.setattr(owner, name, other)
    message = f"has changed its private function {name}.*install hydra-core==1.3.8"
    with pytest.raises(PgdmError, match=message):
        check_interfaces()
    monkeypatch.delattr(owner, name)
    with pytest.raises(PgdmError, match=message):
        Composer()


def test_a_hydra_without_a_private_function_is_reported() -> None:
    code = (
        "import sys, hydra._internal.utils as utils; del utils.create_config_search_path;"
        "from pgdm.cli.run import main; sys.exit(main(['seed=1']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: hydra-core 1.3.8 has changed ")


def test_composing_leaves_hydra_as_it_was() -> None:
    before = defaults_list._create_interpolation_map
    Composer().plain(["task=duck-lift"])
    assert defaults_list._create_interpolation_map is before
