"""The house's one direction: who may import whom, read from the source without running it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "src" / "pgdm"

# From the ground up: a room imports from itself and from floors below its own, never from another
# room on its floor. docs/architecture.md draws this table.
FLOORS: list[set[str]] = [
    {"errors"},
    {"rotations", "seeding", "cem", "paths", "stop"},
    {"library"},
    {"motion"},
    {"sim"},
    {"pregrasp", "wrist"},
    {"mdp"},
    {"envs"},
    {"methods"},
    {"rl"},
    {"tracking"},
    {"config"},
    {"experiment"},
    {"make"},  # environments by task id
    {"pgdm"},  # the package's own __init__: what `import pgdm` offers
    {"sweep", "author"},
    {"report"},
    {"cli", "realworld"},
    {"hydra_plugins"},
]
BASE = FLOORS[0] | FLOORS[1]

# Rooms that see less than their floor allows: learning knows neither simulator nor methods.
NARROW: dict[str, set[str]] = {"rl": BASE}

# Who may import a third-party package; a package that is not listed may be imported anywhere.
ALLOWED: dict[str, set[str]] = {
    "mujoco": {"library", "motion", "sim", "pregrasp", "wrist", "author", "realworld"},
    "torchrl": {"envs.torchrl", "rl"},
    "hydra": {"config.store", "sweep.expand", "cli", "hydra_plugins"},
    "omegaconf": {"config.store", "sweep.expand", "sweep.planning", "cli", "hydra_plugins"},
    "mlflow": {"tracking", "report"},
    "submitit": {"sweep.slurm"},
    "mink": {"pregrasp"},
    "qpsolvers": {"wrist"},
    "viser": {"pregrasp"},
    "trimesh": {"library", "pregrasp"},
    "coacd": {"library"},
    "h5py": {"pregrasp"},
}

Sources = dict[str, str]  # "sim.batch" -> its source; the package's own __init__ is "pgdm"


def read_sources() -> Sources:
    """Return the source of every module, a room's ``__init__`` under the room's name."""
    sources: Sources = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        sources[".".join(parts) or "pgdm"] = path.read_text(encoding="utf-8")
    for path in sorted((REPOSITORY / "src" / "hydra_plugins").rglob("*.py")):
        inner = path.relative_to(REPOSITORY / "src").with_suffix("").parts
        sources[".".join(inner)] = path.read_text(encoding="utf-8")
    return sources


class _NoTypeOnly(ast.NodeTransformer):
    """Drops the bodies of ``if TYPE_CHECKING:``."""

    def visit_If(self, node: ast.If) -> ast.AST:
        """Keep other conditions as they are."""
        if ast.unparse(node.test).endswith("TYPE_CHECKING"):
            node.body = [ast.Pass()]
        return self.generic_visit(node)


def imported(module: str, sources: Sources, type_only: bool = True) -> set[str]:
    """Return what a module imports anywhere: own modules by their key, others by full name.

    Imports inside functions count: they are dependencies as well. So do those under
    ``TYPE_CHECKING``, unless ``type_only`` is false.
    """
    names: set[str] = set()
    tree = ast.parse(sources[module])
    for node in ast.walk(tree if type_only else _NoTypeOnly().visit(tree)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"pgdm.{module} uses a relative import: spell it out"
            origin = node.module or ""
            for alias in node.names:
                full = f"{origin}.{alias.name}"
                names.add(full if full.removeprefix("pgdm.") in sources else origin)
    own = {n.removeprefix("pgdm.") if n.split(".")[0] == "pgdm" else n for n in names}
    return own - {module}


def room(module: str) -> str:
    """Return a module's room: ``sim.batch`` lies in ``sim``."""
    return module.split(".")[0]


def floor(name: str) -> int:
    """Return how high a room lies."""
    return next(i for i, rooms in enumerate(FLOORS) if name in rooms)


def upward_imports(sources: Sources) -> list[str]:
    """Return every import that goes up, sideways, or past what a narrow room may see."""
    wrong = []
    for module in sources:
        here = room(module)
        for target in sorted(imported(module, sources) & set(sources)):
            there = room(target)
            if there == here:
                continue
            below = floor(there) < floor(here)
            if not below or there not in NARROW.get(here, {there}):
                wrong.append(f"{module} imports {target}")
    return wrong


def stray_packages(sources: Sources) -> list[str]:
    """Return every import of a third-party package outside the places it is meant for."""
    wrong = []
    for module in sources:
        for target in sorted(imported(module, sources) - set(sources)):
            places = ALLOWED.get(target.split(".")[0])
            if places is not None and not places & {module, room(module)}:
                wrong.append(f"{module} imports {target}")
    return wrong


def cycle(sources: Sources) -> list[str]:
    """Return the modules of one import cycle, or nothing.

    Two modules of one room may name each other's types; between rooms even that is upward.
    """
    edges = {m: sorted(imported(m, sources, type_only=False) & set(sources)) for m in sources}
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


def test_every_room_has_a_floor() -> None:
    known = set().union(*FLOORS)
    unknown = {room(module) for module in read_sources()} - known
    assert not unknown, f"give these rooms a floor here and in docs/architecture.md: {unknown}"


def test_the_documentation_draws_the_same_floors() -> None:
    page = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", page, re.MULTILINE)
    drawn = {name: int(row) for row, names in rows for name in re.findall(r"`(\w+)`", names)}
    rooms = {room(module) for module in read_sources()}
    assert drawn == {name: floor(name) + 1 for name in rooms}


def test_imports_go_down_only() -> None:
    assert upward_imports(read_sources()) == []


def test_packages_stay_where_they_are_meant_for() -> None:
    assert stray_packages(read_sources()) == []


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
    ],
)
def test_a_violation_is_caught(module: str, source: str) -> None:
    base = {"envs.build": "", "sim.scene": "", "experiment": "", "seeding": "", "pgdm": ""}
    assert upward_imports(base | {module: source}) != []


@pytest.mark.parametrize(
    ("module", "source", "fine"),
    [
        ("mdp.extra", "import mujoco", False),
        ("mdp.extra", "from mujoco import batch", False),
        ("sim.extra", "import mujoco.batch", True),
        ("envs.gym", "import torchrl", False),
        ("envs.torchrl", "from torchrl.envs import EnvBase", True),
        ("config.schema", "from omegaconf import MISSING", False),
        ("config.store", "from hydra import compose", True),
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
    assert cycle(sources | {"sim.c": "if TYPE_CHECKING:\n    import pgdm.sim.a"}) == []
