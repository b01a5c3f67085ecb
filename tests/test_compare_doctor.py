from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image

from command_line import command
from fake_runs import LENGTH, end, make, train
from pgdm.cli import doctor
from pgdm.runs.folder import RunFolder


def run(name: str, seed: int, last: int, lr: float = 5e-4) -> RunFolder:
    folder = make(Path("runs") / name, seed, algo={"name": "sac", "learning_rate": lr})
    train(folder, last=last)
    if last == LENGTH:
        end(folder)
    return folder


def test_runs_are_compared() -> None:
    for name, seed, last, lr in (("a", 0, 10, 5e-4), ("b", 1, 20, 1e-3), ("c", 1, 20, 1e-3)):
        run(name, seed, last, lr)
    outcome = command("pgdm", "compare", "runs/a", "b", "--image", "curves.png")
    assert outcome.code == 0, outcome.err
    lines = [line.split() for line in outcome.out.splitlines()]
    assert ["setting", "a", "b"] in lines and ["result", "a", "b"] in lines
    assert ["seed", "0", "1"] in lines
    assert ["algo.learning_rate", "0.0005", "0.001"] in lines
    assert ["success,", "sampled", "10.0%", "20.0%"] in lines
    assert ["COM", "error", "[m]", "0.0003", "0.0003"] in lines
    assert not any(line[:1] == ["algo.name"] for line in lines)  # the same in both
    with Image.open("curves.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20) or []) > 20
    same = command("pgdm", "compare", "runs/b", "runs/c")
    assert "their settings are the same" in same.out and Path("comparison.png").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["runs/a"], "1 run is named; name at least two different runs"),
        (["runs/a", "runs/../runs/a"], "1 run is named"),
        (["runs/a", "runs/nothing"], "no run folder or checkpoint 'runs/nothing'"),
        (["runs/a", "runs/b", "--image", "x.jpg"], "--image 'x.jpg' is not a PNG"),
    ],
)
def test_what_cannot_be_compared(words: list[str], said: str) -> None:
    for name in ("a", "b"):
        run(name, 0, 10)
    outcome = command("pgdm", "compare", *words)
    assert outcome.code != 0 and said in outcome.errors[0]
    assert not Path("comparison.png").exists()


def test_a_sound_machine(library_home: Path) -> None:
    outcome = command("pgdm", "doctor")
    assert outcome.code == 0, outcome.out
    for words in ("mujoco 4.", "cores, with", "GB are free", "checkout 51 tasks", "mlflow.db in"):
        assert words in " ".join(outcome.out.split())
    assert "PROBLEM" not in outcome.out


def test_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PGDM_HOME", str(tmp_path / "new"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "htp://lab")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    monkeypatch.setattr(doctor, "free_bytes", lambda: 1_000_000_000)
    monkeypatch.setitem(sys.modules, "warp", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "pgdm.sim.warp", raising=False)
    outcome = command("pgdm", "doctor")
    text = " ".join(outcome.out.split())
    assert outcome.code == 1
    assert "only 1.0 GB are free, a run needs about 2: close other programs" in text
    assert "MLflow has no stores of the kind 'htp'" in text and "unset MLFLOW_TRACKING_URI" in text
    assert "rendering is switched off by MUJOCO_GL=disable; unset it to render" in text
    assert "empty; runs fetch what they need" in text
    assert "sim=warp needs MuJoCo Warp" in text
    assert outcome.out.count("PROBLEM") == 2
