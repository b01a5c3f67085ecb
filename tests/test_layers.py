"""Who may import whom, read from the source without running it.

The tables here are the source of those in docs/architecture.md.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "src" / "pgdm"

# From the lowest up: a package or module directly in pgdm imports from itself and from layers below
# its own, never from another one in its layer.
LAYERS: list[set[str]] = [
    {"errors"},
    {"rotations", "seeding", "cem", "files", "limited", "memory", "paths", "stop", "moved"},
    {"library"},
    {"motion"},
    {"sim"},
    {"pregrasp", "wrist"},
    {"mdp"},
    {"envs"},
    {"methods"},
    {"rl"},
    {"runs"},
    {"tracking"},
    {"config"},
    {"experiment"},
    {"make"},  # environments by task id
    {"pgdm"},  # the package's own __init__: what `import pgdm` offers
    {"sweep", "author", "deploy", "export"},
    {"report", "zoo"},
    {"cli"},
    {"__main__"},
]
BASE = LAYERS[0] | LAYERS[1]

# Packages that may import less than their layer allows: `rl` knows neither simulator nor methods.
NARROW: dict[str, set[str]] = {"rl": BASE}

# Where a third-party package is imported, and nowhere else; one that is not listed may be imported
# anywhere.
ALLOWED: dict[str, set[str]] = {
    "mujoco": {"library", "sim", "pregrasp", "wrist", "author", "deploy", "export"},
    "torchrl": {"envs.torchrl", "rl"},
    "hydra": {
        "config.compose",
        "config.explain",
        "config.hydra_private",
        "sweep.expand",
        "cli.jobs",
    },
    "omegaconf": {"config.compose", "config.explain", "config.hydra_private", "cli.jobs"},
    "mlflow": {"tracking", "report"},
    "submitit": {"sweep.slurm"},
    "mink": {"pregrasp", "deploy"},
    "qpsolvers": {"wrist"},
    "viser": {"pregrasp"},
    "trimesh": {"library", "pregrasp"},
    "coacd": {"library"},
    "h5py": {"pregrasp"},
    "stable_baselines3": {"envs.sb3"},
    "safetensors": {"export"},
    "minari": {"export"},
}

Sources = dict[str, str]  # "sim.batch" -> its source; the package's own __init__ is "pgdm"


def read_sources() -> Sources:
    """Return the source of every module, a package's ``__init__`` under the package's name."""
    sources: Sources = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        sources[".".join(parts) or "pgdm"] = path.read_text(encoding="utf-8")
    return sources


class _NoTypeOnly(ast.NodeTransformer):
    """Drops the bodies of ``if TYPE_CHECKING:``."""

    def visit_If(self, node: ast.If) -> ast.AST:
        """Keep other conditions as they are."""
        if ast.unparse(node.test).endswith("TYPE_CHECKING"):
            node.body = [ast.Pass()]
        return self.generic_visit(node)


# Modules named in a string: "pgdm.cli.worker", as after python -m or in import_module(...),
# "pgdm.make:make_gym", or code such as "from pgdm.cli.main import main".
_NAMED = re.compile(r"(pgdm(?:\.\w+)+)(?::\w+)?")
_IN_CODE = re.compile(r"\b(?:from|import)\s+(pgdm(?:\.\w+)*)")


def named_in_strings(tree: ast.AST) -> set[str]:
    """Return the own modules that strings name, docstrings excepted, which are no dependencies."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if id(node) in docstrings:
                continue
            whole = _NAMED.fullmatch(node.value)
            names |= {whole[1]} if whole else set(_IN_CODE.findall(node.value))
    return names


@cache
def _statements(source: str, loaded: bool) -> tuple[set[str], set[tuple[str, str]]]:
    """Return the modules that a source imports, and the pairs of ``from ... import ...``."""
    tree = ast.parse(source)
    pairs: set[tuple[str, str]] = set()
    names = set() if loaded else named_in_strings(tree)
    for node in ast.walk(_NoTypeOnly().visit(tree) if loaded else tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"spell relative imports out: {ast.unparse(node)}"
            pairs |= {(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names |= named_in_strings(node)
    return names, pairs


def imported(module: str, sources: Sources, loaded: bool = False) -> set[str]:
    """Return what a module depends on: own modules by their key, others by full name.

    Imports inside functions count. So do imports under ``TYPE_CHECKING`` and modules that are
    started as processes, unless ``loaded`` asks only for what is loaded with the module.
    """
    names, pairs = _statements(sources[module], loaded)
    full = {f"{origin}.{name}": origin for origin, name in pairs}
    names = names | {f if f.removeprefix("pgdm.") in sources else o for f, o in full.items()}
    own = {n.removeprefix("pgdm.") if n.split(".")[0] == "pgdm" else n for n in names}
    return own - {module}


def places(package: str, sources: Sources) -> set[str]:
    """Return the modules that import a third-party package."""
    return {
        module
        for module in sources
        if any(name.split(".")[0] == package for name in imported(module, sources) - set(sources))
    }


def top_level(module: str) -> str:
    """Return the part of pgdm that a module belongs to: ``sim`` for ``sim.batch``."""
    return module.split(".")[0]


def layer(name: str) -> int:
    """Return the layer of a package or module directly in pgdm, from 0."""
    return next(i for i, names in enumerate(LAYERS) if name in names)


def upward_imports(sources: Sources) -> list[str]:
    """Return every import that goes up, sideways, or past what ``NARROW`` allows."""
    wrong = []
    for module in sources:
        here = top_level(module)
        for target in sorted(imported(module, sources) & set(sources)):
            there = top_level(target)
            if there == here:
                continue
            below = layer(there) < layer(here)
            if not below or there not in NARROW.get(here, {there}):
                wrong.append(f"{module} imports {target}")
    return wrong


def stray_packages(sources: Sources) -> list[str]:
    """Return every import of a third-party package outside the places it is meant for."""
    return [
        f"{module} imports {package}"
        for package, allowed in ALLOWED.items()
        for module in sorted(places(package, sources))
        if not allowed & {module, top_level(module)}
    ]


def unused_permissions(sources: Sources) -> list[str]:
    """Return every permission to import a third-party package that no module uses."""
    return [
        f"{allowed} does not import {package}"
        for package, permitted in ALLOWED.items()
        for allowed in sorted(permitted)
        if not {allowed} & {n for m in places(package, sources) for n in (m, top_level(m))}
    ]


def cycle(sources: Sources) -> list[str]:
    """Return the modules of one import cycle, or nothing.

    Two modules of one package may name each other's types; between packages even that is upward.
    """
    edges = {m: sorted(imported(m, sources, loaded=True) & set(sources)) for m in sources}
    finished: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module in finished:
            return []
        for target in edges[module]:
            if found := visit(target, [*path, module]):
                return found
        finished.add(module)
        return []

    return next((found for module in sources if (found := visit(module, []))), [])


def test_every_package_has_a_layer_and_exists() -> None:
    names = {top_level(module) for module in read_sources()}
    assert names == set().union(*LAYERS), "change LAYERS and the table in docs/architecture.md"
    assert sum(map(len, LAYERS)) == len(names)


def test_the_documentation_has_the_same_tables() -> None:
    page = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", page, re.MULTILINE)
    drawn = [set(re.findall(r"`(\w+)`", names)) for _, names in rows]
    assert [int(number) for number, _ in rows] == list(range(1, len(LAYERS) + 1))
    assert drawn == LAYERS
    _, _, packages = page.partition("| package | where |")
    packages = packages.strip().split("\n\n")[0]
    found: dict[str, set[str]] = {}
    for names, where in re.findall(r"^\| (`[^|]+) \| ([^|]+) \|", packages, re.MULTILINE):
        places = {place.removesuffix(".py").replace("/", ".") for place in _quoted(where)}
        found |= dict.fromkeys(_quoted(names), places)
    assert found == ALLOWED


def _quoted(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def test_imports_go_down_only() -> None:
    assert upward_imports(read_sources()) == []


def test_packages_are_imported_where_they_may_be() -> None:
    assert stray_packages(read_sources()) == []
    assert unused_permissions(read_sources()) == []


def test_no_cycles() -> None:
    assert cycle(read_sources()) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("mdp.extra", "from pgdm.envs import build"),  # up
        ("mdp.extra", "import pgdm.envs.build"),
        ("rotations", "def f():\n    from pgdm.seeding import stream"),  # sideways, and hidden
        ("rl.extra", "from pgdm.sim.scene import Scene"),  # below, but rl is narrow
        ("sim.extra", "from pgdm import experiment"),
        ("sim.extra", "import pgdm"),
        # by name
        ("sweep.extra", "importlib.import_module('pgdm.cli.worker')"),
        ("sweep.extra", "def f():\n    run([sys.executable, '-m', 'pgdm.cli.worker', *more])"),
        ("sweep.extra", "CODE = 'import sys; from pgdm.cli.worker import main; sys.exit(main())'"),
        ("sweep.extra", "code = f'import pgdm.cli.worker; {more}'"),
        ("sim.extra", "register(entry_point='pgdm.envs.build:make')"),
        ("sweep.extra", "if TYPE_CHECKING:\n    from pgdm.cli.worker import main"),
    ],
)
def test_a_violation_is_caught(module: str, source: str) -> None:
    base = {"envs.build": "", "sim.scene": "", "experiment": "", "seeding": "", "pgdm": ""}
    assert upward_imports(base | {"cli.worker": "", module: source}) != []


@pytest.mark.parametrize(
    "source",
    [
        '"""See ``pgdm.cli.worker``, and from pgdm.cli import nothing."""',
        "raise Error('to train: python -m pgdm.cli.worker is not the command')",
        "log = getLogger('pgdm')",
    ],
)
def test_a_mention_is_no_import(source: str) -> None:
    assert upward_imports({"pgdm": "", "cli.worker": "", "sweep.extra": source}) == []


@pytest.mark.parametrize(
    ("module", "source", "fine"),
    [
        ("mdp.extra", "import mujoco", False),
        ("mdp.extra", "from mujoco import batch", False),
        ("sim.extra", "import mujoco.batch", True),
        ("envs.gym", "import torchrl", False),
        ("envs.torchrl", "from torchrl.envs import EnvBase", True),
        ("config.schema", "from omegaconf import MISSING", False),
        ("config.compose", "from hydra import compose", True),
        ("cli.jobs", "from hydra import compose", True),
        ("cli.run", "from hydra import compose", False),
        ("cli.run", "import mlflow", False),
        ("mdp.extra", "import torch", True),
    ],
)
def test_a_stray_package_is_caught(module: str, source: str, fine: bool) -> None:
    assert (stray_packages({module: source}) == []) is fine


def test_a_cycle_is_caught() -> None:
    sources = {
        "sim.a": "from pgdm.sim.b import x",
        "sim.b": "def f():\n    from pgdm.sim import c",
        "sim.c": "import pgdm.sim.a",
        "sim": "",
    }
    assert cycle(sources) == ["sim.a", "sim.b", "sim.c", "sim.a"]
    assert cycle(sources | {"sim.c": ""}) == []
    by_name = "def f():\n    return importlib.import_module('pgdm.sim.a')"
    assert cycle(sources | {"sim.c": by_name}) != []
    assert cycle(sources | {"sim.c": "if TYPE_CHECKING:\n    import pgdm.sim.a"}) == []
