from __future__ import annotations

import json
import logging
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pgdm.errors import RunError
from pgdm.runs.log import RunLog, metrics_of


def filled(path: Path, count: int = 3) -> RunLog:
    log = RunLog(path / "metrics.jsonl")
    for i in range(1, count + 1):
        log.append({"train/kl": i / 4}, frames=100 * i, iteration=i, time_s=i, kind="train")
    return log


def test_a_line_is_what_the_contract_says(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "metrics.jsonl")
    values = {"train/kl": np.float32(0.25), "train/length": 85}
    log.append(values, frames=4096, iteration=1, time_s=2.00049, kind="train")
    assert log.path.read_text() == (
        '{"frames": 4096, "iteration": 1, "time_s": 2.0, "kind": "train", '
        '"train/kl": 0.25, "train/length": 85.0}\n'
    )


def test_values_that_are_not_finite_stay_json(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "metrics.jsonl")
    values = {"a": math.nan, "b": math.inf, "c": 1.0}
    log.append(values, frames=1, iteration=1, time_s=0, kind="train")
    json.loads(log.path.read_text(), parse_constant=lambda name: pytest.fail(name))
    (record,) = log.read()
    assert math.isnan(record["a"]) and math.isnan(record["b"])
    assert metrics_of(record) == {"c": 1.0}


def test_missing_file_is_an_empty_log(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "metrics.jsonl")
    assert log.read() == []
    assert log.tail() == []
    assert log.truncate(5) == 0
    assert not log.path.exists()


def test_unfinished_last_line_is_passed_over_and_then_removed(tmp_path: Path) -> None:
    log = filled(tmp_path)
    with open(log.path, "ab") as file:
        file.write(b'{"frames": 400, "iteration": 4, "tim')
    assert [r["frames"] for r in log.read()] == [100, 200, 300]
    assert [r["frames"] for r in log.tail()] == [100, 200, 300]
    log.append({}, frames=400, iteration=4, time_s=4, kind="train")
    assert [json.loads(line)["frames"] for line in log.path.read_text().splitlines()] == [
        100,
        200,
        300,
        400,
    ]


def test_file_of_one_unfinished_line(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "metrics.jsonl")
    log.path.write_bytes(b'{"fra')
    log.append({}, frames=1, iteration=1, time_s=1, kind="train")
    assert [r["frames"] for r in log.read()] == [1]


@given(cut=st.integers(0, 400))
@settings(max_examples=60, deadline=None)
def test_any_cut_costs_at_most_the_line_it_is_in(
    cut: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    log = filled(tmp_path_factory.mktemp("log"), 4)
    whole = log.path.read_bytes()
    log.path.write_bytes(whole[:cut])
    kept = whole[:cut].count(b"\n")
    assert [r["frames"] for r in log.read()] == [100 * i for i in range(1, kept + 1)]
    log.append({}, frames=900, iteration=9, time_s=9, kind="train")
    assert [r["frames"] for r in log.read()] == [*(100 * i for i in range(1, kept + 1)), 900]


@pytest.mark.parametrize(
    "line",
    ["[]", "{}", "3", '{"frames": "x", "kind": "train"}', '{"frames": 5, "kind": "eval", "a": []}'],
)
def test_damaged_line_in_the_middle_is_named_and_left_out(
    line: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = filled(tmp_path, 1)
    with open(log.path, "a") as file:
        file.write(line + "\n")
    log.append({}, frames=300, iteration=3, time_s=3, kind="train")
    with caplog.at_level(logging.WARNING):
        assert [r["frames"] for r in log.read()] == [100, 300]
    assert "line 2 is damaged" in caplog.text


def test_of_equal_lines_the_last_counts(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "metrics.jsonl")
    for value, kind in ((1.0, "eval"), (2.0, "train"), (3.0, "eval")):
        log.append({"x": value}, frames=100, iteration=1, time_s=1, kind=kind)
    assert [(r["kind"], r["x"]) for r in log.read()] == [("train", 2.0), ("eval", 3.0)]


def test_truncate_keeps_what_the_checkpoint_knows(tmp_path: Path) -> None:
    log = filled(tmp_path)
    with open(log.path, "ab") as file:
        file.write(b'{"fram')
    assert log.truncate(200) == 2
    assert [r["frames"] for r in log.read()] == [100, 200]
    before = log.path.stat().st_ino
    assert log.truncate(200) == 0
    assert log.path.stat().st_ino == before  # nothing to do, nothing written
    assert log.truncate(-1) == 2
    assert log.read() == []
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_tail_of_a_long_log(tmp_path: Path) -> None:
    log = filled(tmp_path, 2)
    many = log.path.read_bytes() * 10000
    log.path.write_bytes(many)
    tail = log.tail()
    assert 100 < len(tail) < 20000
    assert tail[-1]["frames"] == 200


def test_thinned_log_has_every_evaluation(tmp_path: Path) -> None:
    log = filled(tmp_path, 1000)
    for i in (1, 500, 1000, 1000):
        log.append({"eval/success": i / 2}, frames=100 * i, iteration=i, time_s=i, kind="eval")
    with open(log.path, "a") as file:
        file.write('{"frames": 5, "kind": "eval"')  # a process died while it wrote
    found = log.thinned(50)
    evaluations = [record for record in found if record["kind"] == "eval"]
    assert [record["frames"] for record in evaluations] == [100, 50000, 100000]
    frames = [int(record["frames"]) for record in found if record["kind"] == "train"]
    assert 45 <= len(frames) <= 50
    assert max(np.diff(frames)) <= 3000
    assert all(record in log.read() for record in found)


def test_thinned_short_log_is_whole(tmp_path: Path) -> None:
    log = filled(tmp_path, 3)
    assert log.thinned(100) == log.read()
    assert RunLog(tmp_path / "none").thinned(100) == []


def test_unwritable_log_names_the_cure(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "gone" / "metrics.jsonl")
    with pytest.raises(RunError, match=r"No such file.*start the same command again"):
        log.append({}, frames=1, iteration=1, time_s=1, kind="train")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_is_one_line(tmp_path: Path) -> None:
    os.symlink("/dev/full", tmp_path / "metrics.jsonl")
    with pytest.raises(RunError, match="No space left"):
        RunLog(tmp_path / "metrics.jsonl").append({}, frames=1, iteration=1, time_s=1, kind="train")
