"""The glossary of docs/concepts.md and the pages of the Python API name things that exist."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from pgdm import moved

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "src" / "pgdm"
DOCS = REPOSITORY / "docs"
PAGE = (DOCS / "concepts.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (.+?) \| (.+?) \| `(pgdm\.[\w.]+)` \|$", PAGE.split("## Glossary")[1], re.M)
API = re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.M)

# Words that no public name contains any more, and the word of the glossary to use instead.
DEPRECATED = {
    "exemplar": "motion",
    "trajectory": "motion",
    "continue": "resume",
}


ARCHITECTURE = (DOCS / "architecture.md").read_text(encoding="utf-8")
PATHS = re.findall(
    r"`((?:\w+\.)+\w+)`", ARCHITECTURE.split("## The path of the data")[1].split("\n## ")[0]
)


def resolve(path: str) -> object:
    """Return what a dotted path names: a module, a class, a function, or a field of a class.

    Raises:
        LookupError: if there is no such thing; the message names the part that is missing.
    """
    parts = path.split(".")
    found: object = importlib.import_module(parts[0])
    for i, part in enumerate(parts[1:], 1):
        here = ".".join(parts[: i + 1])
        fields = getattr(found, "__dataclass_fields__", {})
        if inspect.ismodule(found) and not hasattr(found, part):
            try:
                importlib.import_module(here)
            except ModuleNotFoundError as error:
                raise LookupError(f"'{here}' does not exist") from error
        if part in fields:
            return found  # a field without a default is no attribute of its class
        if not hasattr(found, part):
            raise LookupError(f"'{here}' does not exist")
        found = getattr(found, part)
    return found


def modules() -> dict[str, Path]:
    """Return the file of every module of the package, a package under its own name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


def public_names() -> Iterator[tuple[str, str]]:
    """Yield every public module, class and function of the package: its module, its own name."""
    for module, path in modules().items():
        yield module, module.rpartition(".")[2]
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
            if isinstance(node, kinds) and not node.name.startswith("_"):
                yield module, node.name


def words(name: str) -> set[str]:
    """Return the words of an identifier, in lower case: ``WristPlan`` and ``wrist_plan`` alike."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def missing(paths: Iterable[str]) -> list[str]:
    """Return what is wrong with each of the paths that name nothing, or something renamed."""
    found = []
    for path in sorted(set(paths)):
        try:
            resolve(path)
        except (LookupError, DeprecationWarning) as error:  # pytest makes errors of warnings
            found.append(str(error))
    return found


def test_the_code_has_what_the_glossary_names() -> None:
    wrong = missing(path for _, _, path in ROWS)
    assert wrong == [], "write the present names in docs/concepts.md, Glossary"


def test_the_code_has_what_the_path_of_the_data_names() -> None:
    files = {"plan.json", "checkpoint.interval_s"}  # a file and a setting, not code
    assert len(PATHS) > 40
    wrong = missing(f"pgdm.{path}" for path in PATHS if path not in files)
    assert wrong == [], "write the present names in docs/architecture.md, The path of the data"


def test_every_row_of_the_glossary_is_read() -> None:
    lines = [line for line in PAGE.split("## Glossary")[1].splitlines() if line.startswith("| ")]
    assert len(ROWS) == len(lines) - 1, "a row has no `pgdm....` name in its third column"
    assert len(ROWS) > 40


def test_one_term_for_one_thing() -> None:
    terms = Counter(term for term, _, _ in ROWS)
    # By what is named, since one thing may be imported from two places; a field by its class.
    things = Counter((id(resolve(path)), path.rpartition(".")[2]) for _, _, path in ROWS)
    twice = [term for term, n in terms.items() if n > 1]
    twice += [name for (_, name), n in things.items() if n > 1]
    assert twice == [], "docs/concepts.md, Glossary: named twice"


@pytest.mark.parametrize("path", API)
def test_the_api_pages_name_what_exists(path: str) -> None:
    found = resolve(path)
    if inspect.ismodule(found):
        classes = [c for _, c in inspect.getmembers(found, inspect.isclass) if c.__doc__]
        assert [c.__name__ for c in classes if c.__module__ == path], f"{path} has no class to show"
    else:
        # It must also be what its own module calls by that name, and not an old alias.
        assert getattr(found, "__name__", None) == path.rpartition(".")[2]


def test_no_public_name_has_a_deprecated_word() -> None:
    old = [
        f"{module}: {name} (use '{DEPRECATED[word]}' for '{word}')"
        for module, name in public_names()
        for word in words(name) & DEPRECATED.keys()
    ]
    assert old == [], "names that the glossary replaced:\n" + "\n".join(old)


def test_old_module_names_are_free_and_lead_to_modules() -> None:
    present = {name.removeprefix("pgdm.") for name in modules()}
    assert present & moved.MOVED.keys() == set(), "src/pgdm/moved.py: these modules exist"
    assert set(moved.MOVED.values()) - present == set(), "src/pgdm/moved.py: these do not"


@pytest.mark.parametrize(
    ("path", "part"),
    [
        ("pgdm.mdp.recipe.Recipes", "pgdm.mdp.recipe.Recipes"),
        ("pgdm.mdp.recipes.Recipe", "pgdm.mdp.recipes"),
        ("pgdm.library.Motion.frames", "pgdm.library.Motion.frames"),
    ],
)
def test_what_is_missing_is_named(path: str, part: str) -> None:
    with pytest.raises(LookupError, match=f"'{part}' does not exist"):
        resolve(path)


def test_words_of_a_name() -> None:
    assert words("WristPlan") == words("wrist_plan") == {"wrist", "plan"}
    assert words("SACLearner") == {"sac", "learner"}
