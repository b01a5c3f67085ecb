"""The zoo: entries reproduce their results to the bit, and damaged ones are refused."""

from __future__ import annotations

import hashlib
import json
import lzma
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml

from command_line import TINY_SAC, command, unchanged
from pgdm.errors import PgdmError, ZooError
from pgdm.export import tensors
from pgdm.export.tensors import MOST_BYTES
from pgdm.export.trained import of_run
from pgdm.zoo import Zoo
from pgdm.zoo.policy import open_entry

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "tools"))
import fill_zoo  # noqa: E402 (tools/ is no package: nothing in src may import it)

TASK = "dmanus-crackerbox"
FILE = f"{TASK}.safetensors.xz"

pytestmark = pytest.mark.usefixtures("library_home")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with ``runs`` and the ``zoo`` made of them."""
    folder = tmp_path_factory.mktemp("made")
    for seed, name in ((1, "later"), (0, "first")):
        line = ("+experiment=fast", f"task={TASK}", *TINY_SAC, f"seed={seed}", "eval.episodes=3")
        done = command("pgdm-run", *line, f"run_dir={folder / 'runs' / name}", "--offline")
        assert done.code == 0, done.err
    shutil.copytree(folder / "runs" / "first", folder / "runs" / "killed")
    (folder / "runs" / "killed" / "result.json").unlink()
    with unchanged(*(folder / "runs").rglob("*.ckpt"), *(folder / "runs").rglob("*.json*")):
        assert fill_zoo.fill(folder / "runs", folder / "zoo", False, False) == 0
    return folder


@pytest.fixture
def zoo(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made / "zoo", tmp_path / "zoo")
    monkeypatch.setenv("PGDM_ZOO", str(tmp_path / "zoo"))
    return tmp_path / "zoo"


def test_a_finished_run_is_reproduced_to_the_bit(made: Path, zoo: Path) -> None:
    entries = Zoo().entries
    assert list(entries) == [TASK] and entries[TASK].seed == 0
    assert entries[TASK].bytes == (zoo / FILE).stat().st_size
    outcome = command("pgdm", "eval", f"zoo:{TASK}", "--offline")
    assert outcome.code == 0, outcome.err
    assert "stored result: reproduced, all" in outcome.out
    policy = open_entry(Zoo(), TASK)
    assert f"{policy.evaluation['eval_sampled/success']:.1%}" in outcome.out
    run = of_run(made / "runs" / "first")
    assert policy.sha256() in {run.sha256(), tensors.halved(run).sha256()}
    assert policy.facts == run.facts and policy.commands is not None


def test_a_changed_result_is_said(zoo: Path) -> None:
    about = tensors.about((zoo / FILE).read_bytes(), TASK)
    about["evaluation"]["eval_sampled/success"] += 0.01
    policy = open_entry(Zoo(), TASK)
    half = about["precision"] == "float16"
    content = tensors.compressed(tensors.pack(policy, policy.commands, about, half))
    (zoo / FILE).write_bytes(content)
    index = json.loads((zoo / "index.json").read_text())
    index["entries"][TASK] |= {"sha256": hashlib.sha256(content).hexdigest()}
    (zoo / "index.json").write_text(json.dumps(index))
    outcome = command("pgdm", "zoo", "eval", TASK, "--offline")
    assert outcome.code == 1 and "not reproduced, 1 of" in outcome.out


def test_filling_again_adds_what_is_new(made: Path, zoo: Path) -> None:
    with unchanged(zoo):
        assert fill_zoo.fill(made / "runs", zoo, False, False) == 0
    assert fill_zoo.fill(made / "runs", zoo, False, True) == 0
    assert list(Zoo().entries) == [TASK, f"{TASK}-s1"]
    assert Zoo().entries[f"{TASK}-s1"].seed == 1


def test_list_show_and_get(zoo: Path, tmp_path: Path) -> None:
    outcome = command("pgdm", "zoo", "list")
    assert outcome.code == 0 and f"1 policy in {zoo}" in outcome.out
    assert "float16" not in outcome.out and TASK in outcome.out
    shown = yaml.safe_load(command("pgdm", "zoo", "show", TASK).out)
    assert shown["task"] == TASK and shown["settings"]["algo"]["learner"] == "sac"
    assert shown["facts"]["wrist_sha256"] and shown["run"]["name"] == "first"
    assert "run_dir" not in shown["settings"] and str(tmp_path) not in yaml.safe_dump(shown)
    outcome = command("pgdm", "zoo", "get", TASK)
    assert outcome.code == 0, outcome.err
    back = tensors.read(tmp_path / f"{TASK}.safetensors")
    assert back.sha256() == shown["policy_sha256"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lzma.compress(bytes(MOST_BYTES + 1), preset=0), "would unpack to more than"),
        (lzma.compress(b"x")[:-4], "cut off|damaged"),
    ],
    ids=["too large", "cut off"],
)
def test_get_unpacks_only_what_a_policy_may_be(content: bytes, message: str, zoo: Path) -> None:
    (zoo / FILE).write_bytes(content)
    index = json.loads((zoo / "index.json").read_text())
    digest = hashlib.sha256(content).hexdigest()
    index["entries"][TASK] |= {"sha256": digest, "bytes": len(content)}
    (zoo / "index.json").write_text(json.dumps(index))
    outcome = command("pgdm", "zoo", "get", TASK)
    assert outcome.code == 1 and re.search(message, outcome.err), outcome.err


@pytest.mark.slow
def test_commands_of_the_page(zoo: Path) -> None:
    page = (REPOSITORY / "docs" / "zoo.md").read_text(encoding="utf-8")
    lines = re.findall(r"^pgdm .*$", page.replace("hammer-use1", TASK), re.MULTILINE)
    assert len(lines) == 6
    for line in lines:
        words = [word for word in line.split() if word != "--video"]
        done = command(*words, *(["--offline"] if {"eval", "export"} & set(words) else []))
        assert done.code == 0, done.err


@pytest.fixture
def address(zoo: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(zoo)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_zoo_at_an_address(zoo: Path, address: str) -> None:
    assert Zoo(address).content(TASK) == (zoo / FILE).read_bytes()
    outcome = command("pgdm", "zoo", "list", "--from", address)
    assert outcome.code == 0 and f"1 policy in {address}" in outcome.out
    (zoo / FILE).unlink()
    with pytest.raises(ZooError, match=f"cannot read {address}{FILE}: 404 File not found"):
        Zoo(address).content(TASK)
    with pytest.raises(ZooError, match=r"cannot read http://127\.0\.0\.1:9/index\.json"):
        _ = Zoo("http://127.0.0.1:9").entries


def truncate(zoo: Path) -> None:
    (zoo / FILE).write_bytes((zoo / FILE).read_bytes()[:-1])


def index(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def apply(zoo: Path) -> None:
        content = json.loads((zoo / "index.json").read_text())
        change(content)
        (zoo / "index.json").write_text(json.dumps(content))

    return apply


def escape(content: dict[str, Any]) -> None:
    content["entries"]["../../x"] = content["entries"][TASK]


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a damaged file": (truncate, "its SHA-256 is not that of the index"),
    "no file": (lambda zoo: (zoo / FILE).unlink(), "cannot read"),
    "no index": (lambda zoo: (zoo / "index.json").unlink(), "cannot read"),
    "a damaged index": (lambda zoo: (zoo / "index.json").write_text("{"), "is damaged"),
    "a list": (lambda zoo: (zoo / "index.json").write_text("[]"), "is damaged"),
    "a newer format": (index(lambda c: c.update(format="x")), "has format 'x'"),
    "a path": (index(escape), "is damaged"),
    "text as number": (index(lambda c: c["entries"][TASK].update(frames="1")), "'frames' is '1'"),
    "another task": (index(lambda c: c["entries"][TASK].update(task="x")), "not 'x'"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_zoos(kind: str, zoo: Path) -> None:
    change, said = BAD[kind]
    change(zoo)
    with pytest.raises(PgdmError) as caught:
        open_entry(Zoo(), TASK)
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.skipif(not fill_zoo.ZOO.is_dir(), reason="the checkout has no zoo")
def test_the_zoo_of_the_repository() -> None:
    zoo = Zoo(str(fill_zoo.ZOO))
    assert sum(entry.bytes for entry in zoo.entries.values()) < 1e6 * fill_zoo.MOST_MB
    for name, entry in zoo.entries.items():
        policy = open_entry(zoo, name)
        assert policy.frames == entry.frames
        assert policy.evaluation["eval_sampled/success"] == entry.success
    names = {path.name.removesuffix(".safetensors.xz") for path in fill_zoo.ZOO.glob("*.xz")}
    assert names == set(zoo.entries)


def test_names_and_places_that_do_not_exist(zoo: Path) -> None:
    outcome = command("pgdm", "eval", "zoo:dmanus-crackerbux")
    assert outcome.code == 2 and f"did you mean {TASK}?" in outcome.err
    outcome = command("pgdm", "zoo", "list", "--from", "nowhere")
    assert outcome.code == 2 and "there is no zoo in 'nowhere'" in outcome.err
    outcome = command("pgdm", "eval", f"zoo:{TASK}", "--best")
    assert outcome.code == 2 and "takes no --best" in outcome.err
