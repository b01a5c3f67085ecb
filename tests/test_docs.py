"""The documentation builds without a warning, and its commands and recipes work."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from command_line import TINY, TINY_SAC, command, process
from pgdm.config.compose import compose
from pgdm.config.suites import expand_tasks
from pgdm.runs.log import RunLog
from pgdm.sweep.expand import grid
from pgdm.sweep.studies import open_study

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = sorted(DOCS.rglob("*.md"))

sys.path.insert(0, str(REPOSITORY / "tools"))
import configuration_page  # noqa: E402 (tools/ is no package: nothing in src may import it)


def test_the_page_of_settings_is_current() -> None:
    page = configuration_page.PAGE.read_text(encoding="utf-8")
    assert page == configuration_page.page(), "run: python tools/configuration_page.py"


def test_every_setting_is_explained() -> None:
    lines = configuration_page.page().splitlines()
    assert [line for line in lines if line.startswith("| `") and line.endswith("|  |")] == []


def test_every_page_is_in_the_navigation() -> None:
    text = (REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8")
    nav = set(re.findall(r"^ +- [^:]+: (\S+\.md)$", text, re.MULTILINE))
    assert nav == {str(page.relative_to(DOCS)) for page in PAGES}


def test_the_site_builds_strictly(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    # The site must work without a network: nothing is loaded from elsewhere.
    loaded = re.compile(r'<(?:script|img)[^>]* src="?(?:https?:)?//|stylesheet[^>]* href="?https?:')
    assert [p.name for p in pages if loaded.search(p.read_text(encoding="utf-8"))] == []


def _commands() -> list[str]:
    """Return every pgdm-run command of the documentation, in code blocks and in the text."""
    found: set[str] = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        found |= set(re.findall(r"^pgdm-run .*$", text, re.MULTILINE))
        found |= set(re.findall(r"`(pgdm-run [^`\n]+)`", text))
    placeholder = re.compile(r"[A-Z]{3,}|<|--config-dir|--help")
    return sorted(command for command in found if not placeholder.search(command))


@pytest.mark.parametrize("command", _commands())
def test_settings_in_commands_exist(command: str) -> None:
    bare = re.sub(r"'[^']*'|\"[^\"]*\"", "", command)
    assert not re.search(r"[()\[\]{}*?]", bare), "quote it: a shell expands or rejects this"
    words = [word for word in shlex.split(command)[1:] if not word.startswith("-")]
    words = [word for word in words if word != "job"]
    study, typed, written = open_study(words)
    if study is not None or " -m " in command:
        jobs = grid(
            OverridesParser.create().parse_overrides([*written, *typed]), expand_tasks, 10_000
        )
        typed = [word for word in jobs[-1] if not word.startswith("hydra")]
    compose([word for word in typed if word != "device=cuda"])  # refused without a GPU


def _follow(heading: str, folder: Path, page: str = "extending.md") -> None:
    """Write the files that a section of a page has its reader write."""
    text = (DOCS / page).read_text(encoding="utf-8")
    section = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    step = r"Write `([^`]+)`[^`]*?(?:`[^`]+`[^`]*?)*:\n\n    ```\w+\n(.*?)    ```"
    files = re.findall(step, section, re.DOTALL)
    assert files, f"docs/{page} writes no file under '{heading}'"
    for name, body in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(re.sub(r"(?m)^    ", "", body), encoding="utf-8")


def test_recipe_for_a_named_experiment(tmp_path: Path) -> None:
    _follow("A named experiment", tmp_path)
    cfg = compose(["+experiment=ours", "task=cup-pour1"], tmp_path / "my")
    assert (cfg.action.kind, cfg.algo.name, cfg.total_frames) == ("residual", "ppo_fast", 1_000_000)
    assert cfg.task.id == "cup-pour1"


def _author_commands(page: str, heading: str) -> list[list[str]]:
    """Return the commands of a section that make or remove something, as words."""
    section = (DOCS / page).read_text(encoding="utf-8").split(f"\n## {heading}\n")[1]
    section = section.split("\n## ")[0]
    return [
        line.split()[1:]
        for line in re.findall(r"pgdm author (?:object|hand|task) [^`\n]+", section)
    ]


def _run_python(file: str) -> str:
    place = os.environ | {"PYTHONPATH": str(REPOSITORY / "src")}
    done = subprocess.run(
        [sys.executable, file], capture_output=True, text=True, check=False, env=place
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search hand poses briefly: how good they are does not matter here."""
    from pgdm.pregrasp import near

    for name, count in {"STARTS": 2, "ROUNDS": 12}.items():
        monkeypatch.setattr(near, name, count)


def test_recipes_for_an_object_and_its_task(
    tmp_path: Path, own_library: Path, hurried: None
) -> None:
    for heading in ("An object", "A task"):
        _follow(heading, tmp_path)
    _run_python("wedge.py")
    made = [
        *_author_commands("extending.md", "An object"),
        *_author_commands("extending.md", "A task"),
    ]
    assert [words[1] for words in made] == ["object", "task"]
    for words in made:
        outcome = command("pgdm", *words)
        assert outcome.code == 0, outcome.err
    done = command(
        "pgdm-run", "+experiment=fast", "task=wedge-slide", *TINY_SAC, "--offline", "run_dir=run"
    )
    assert done.code == 0, done.err
    assert command("pgdm", "author", "remove", "wedge-slide", "--yes").code == 0


@pytest.mark.slow
def test_the_tool_behind_the_animated_tasks(
    tmp_path: Path, library_home: Path, hurried: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import animated_starts

    task = "dhand-spheremedium-lift"
    copy = shutil.copytree(animated_starts.animated.FOLDER, tmp_path / "keyframes")
    monkeypatch.setattr(animated_starts.animated, "FOLDER", copy)
    before = animated_starts.animated.read(task)
    animated_starts.find(task, tmp_path)
    after = animated_starts.animated.read(task)
    assert after.object_joints == pytest.approx(before.object_joints, abs=1e-3)
    assert after.hand_joints != pytest.approx(before.hand_joints, abs=1e-3)  # a short search
    assert (tmp_path / f"{task}.png").is_file()


def test_recipe_for_a_pregrasp_source(tmp_path: Path, library_home: Path) -> None:
    _follow("A pre-grasp of your own", tmp_path)
    assert "deepest penetration: 0.0 mm" in _run_python("spread.py")
    done = command(
        "pgdm-run", "task=hammer-use1", "pregrasp=labeled", *TINY, "--offline", "run_dir=r"
    )
    assert done.code == 0, done.err


@pytest.mark.slow
def test_the_worked_example_of_authoring(tmp_path: Path, own_library: Path) -> None:
    _follow("A worked example", tmp_path, "authoring.md")
    _run_python("pawn.py")
    for words in _author_commands("authoring.md", "A worked example"):
        outcome = command("pgdm", *words)
        assert outcome.code == 0, outcome.err
    done = command(
        "pgdm-run", "+experiment=fast", "task=pawn-lift", *TINY_SAC, "--offline", "run_dir=run"
    )
    assert done.code == 0, done.err


def test_recipe_for_a_task(tmp_path: Path, library_home: Path) -> None:
    import torch

    from pgdm.experiment import env_builder
    from pgdm.library import open_library

    _follow("A task", tmp_path)
    cfg = compose(["task=dhand-hammer", "pregrasp=none"], tmp_path / "my")
    assert cfg.hand.name == "dhand"
    env = env_builder(cfg, open_library()).make(num_envs=2, num_threads=1)
    obs, reward, *_ = env.step(torch.zeros(2, env.action_dim))
    assert torch.isfinite(obs).all()
    assert torch.isfinite(reward).all()


def test_recipe_for_a_hand(tmp_path: Path, library_home: Path) -> None:
    from pgdm.experiment import env_builder
    from pgdm.library import open_library

    _follow("A hand", tmp_path)
    choices = ["task=cup-pour1", "hand=adroit-tips"]
    seen = env_builder(compose(choices, tmp_path / "my"), open_library()).make(1, 1)
    whole = env_builder(compose(choices[:1]), open_library()).make(1, 1)
    # Each of the ten points less is a position, a quaternion and two velocities.
    assert whole.obs_dim - seen.obs_dim == 10 * (3 + 4 + 6)


def test_recipe_for_a_hand_of_ones_own(tmp_path: Path, library_home: Path) -> None:
    _follow("A hand", tmp_path)
    _run_python("gripper.py")
    (made,) = _author_commands("extending.md", "A hand")[:1]
    outcome = command("pgdm", *made)
    assert outcome.code == 0, outcome.err
    assert "6: 3 with a servo each, 3 that follow" in outcome.out
    run = ("task=cup-pour1", "hand=gripper", "pregrasp=none", "run_dir=run", *TINY)
    done = command("pgdm-run", *run)
    assert done.code == 0, done.err
    assert command("pgdm", "author", "remove", "gripper", "--yes").code == 0


def test_recipe_for_a_method(tmp_path: Path, library_home: Path) -> None:
    _follow("Steps", tmp_path, "methods/your-own.md")
    page = (DOCS / "methods" / "your-own.md").read_text(encoding="utf-8")
    looked, ran = re.findall(r"^    pgdm-run (.*)$", page, re.MULTILINE)
    place = {"PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), "my"])}
    shown = process("pgdm-run", *looked.split(), env=place)
    assert re.search(r"reward +near +1 ", shown.out), shown.err
    done = process("pgdm-run", *ran.split(), *TINY, "--offline", "run_dir=run", env=place)
    assert done.code == 0, done.err
    line = RunLog(tmp_path / "run" / "metrics.jsonl").read()[-1]
    # The cup is within 3 cm of its target in each of the first steps.
    assert line["eval_deterministic/raw/near"] >= 1
    assert line["eval_deterministic/term/near"] == line["eval_deterministic/raw/near"]
    failed = process("pgdm-run", *looked.split(), env={"PYTHONPATH": str(REPOSITORY / "src")})
    assert failed.code == 2 and "cannot import 'near_method'" in failed.err
