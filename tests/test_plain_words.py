"""Plain words: no sentence of the package, its settings or its pages has a phrase listed here."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "src" / "pgdm"

SOURCE = "name the source in words: released code; paper, Sec. III; paper, App. B"
# Phrases and what to write instead. A space stands for any white space, such as a line's end.
WRONG = {
    r"(?-i:\bSPEC\b|\bDESIGN\b)": SOURCE,
    r"(?-i:\([RP]\)|\([RP][,;] [a-z]|[a-z]{3}, [RP]\)|\bP (?:App|[IVX]+)\b)": SOURCE,
    r"\bcompare by (?:their|its) mean": "their means are not comparable",
    r"\bwith what a result\b": "versions and git revision behind a result",
    r"\btaken away\b": "removed, ablated",
    r"\bt(?:old|ells?) (?:\w+ ){0,3}apart\b": "distinguish",
    r"\bbeside the paper\b": "next to, compared with",
    r"\blooked after\b": "monitored",
    r"\bsooner or later\b": "name the event",
    r"\bwhere there is none\b": "if missing",
    r"\b(?:a|have no) word from\b|\bhave no word\b": "explicit confirmation",
    r"\bwhat lies in\b": "contents of",
    r"\bnot as it (?:must|should) be\b": "deviates",
    r"\bgo(?:es)? on (?:with|from|where|later|under|at|in)\b": "resume, continue",
    r"\blifted by none\b": "no policy lifts it",
    r"\bbetter than expected it went\b|\bshould have said\b": "advantage; value target",
    r"\bno-slip success\b": "rigid grasp",
    r"\btrainings\b|\ba training[.,;: ](?!run|set|loop|curve)": "run",
    r"\bTorchRL's (?:own )?parts\b": "components",
    r"\bfigures?\b": "value, number, metric (a figure is a plot)",
}
COMPILED = [
    (re.compile(phrase.replace(" ", r"\s+"), re.IGNORECASE), advice)
    for phrase, advice in WRONG.items()
]
# Where figures are plots.
PLOTS = ("src/pgdm/report/", "docs/report.md", "docs/study.md")

Passage = tuple[int, str]  # first line and text


def _strings(node: ast.AST) -> Iterator[Passage]:
    """Yield the string literals below a node; of an f-string, its text with {} for values."""
    if isinstance(node, ast.JoinedStr):
        parts = [p.value if isinstance(p, ast.Constant) else "{}" for p in node.values]
        yield node.lineno, "".join(map(str, parts))
        children = [p.value for p in node.values if isinstance(p, ast.FormattedValue)]
    else:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from _strings(child)


def _comments(lines: list[tuple[int, str]]) -> Iterator[Passage]:
    """Yield comments, those on adjacent lines as one."""
    start, text, last = 0, "", -1
    for line, comment in lines:
        if line != last + 1:
            if text:
                yield start, text
            start, text = line, ""
        text += comment.lstrip("#") + "\n"
        last = line
    if text:
        yield start, text


def passages(path: Path) -> list[Passage]:
    """Return the prose of a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return [(1, text)]
    if path.suffix == ".yaml":
        lines = enumerate(text.splitlines(), 1)
        return list(_comments([(n, s.strip()) for n, s in lines if s.strip().startswith("#")]))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = [(t.start[0], t.string) for t in tokens if t.type == tokenize.COMMENT]
    strings = [(n, s) for n, s in _strings(ast.parse(text)) if len(s.split()) > 1]  # not names
    return [*strings, *_comments(comments)]


def hits(path: Path, name: str) -> list[str]:
    """Return a line for each wrong phrase of a file."""
    found = []
    for start, text in passages(path):
        for wrong, advice in COMPILED:
            if "figure" in wrong.pattern and name.startswith(PLOTS):
                continue
            for match in wrong.finditer(text):
                line = start + text.count("\n", 0, match.start())
                found.append(f"{name}:{line}: {' '.join(match[0].split())!r} -> {advice}")
    return found


PLACES = [
    *(path.relative_to(REPOSITORY).as_posix() for path in sorted(PACKAGE.iterdir())),
    *("src/hydra_plugins", "conf", "sweeps", "docs", "README.md"),
]


@pytest.mark.parametrize("name", [name for name in PLACES if "__pycache__" not in name])
def test_no_phrase_that_is_always_wrong_here(name: str) -> None:
    place = REPOSITORY / name
    files = [place] if place.is_file() else sorted(place.rglob("*"))
    found = []
    for file in files:
        if file.suffix in (".py", ".yaml", ".md"):
            found += hits(file, file.relative_to(REPOSITORY).as_posix())
    if found:
        pytest.fail("\n".join(found), pytrace=False)


def test_every_kind_of_passage_is_read(tmp_path: Path) -> None:
    code, settings = tmp_path / "a.py", tmp_path / "a.yaml"
    code.write_text('"""Told\napart."""\nx = 1  # looked\n# after\ny = f"{x} taken " "away (R)"\n')
    settings.write_text("a: 1\n# Beside\n  # the paper.\nb: 'where there is none'\n")
    found = [hit.split(" -> ")[0] for hit in [*hits(code, "a.py"), *hits(settings, "a.yaml")]]
    assert sorted(found) == [
        "a.py:1: 'Told apart'",
        "a.py:3: 'looked after'",
        "a.py:5: '(R)'",
        "a.py:5: 'taken away'",
        "a.yaml:2: 'Beside the paper'",
    ]
    code.write_text("# (n, P), (F, R) and a rotation R\nx = 'figures'  # Figures (see App. P)\n")
    assert hits(code, "a.py") == ["a.py:2: 'Figures' -> value, number, metric (a figure is a plot)"]
