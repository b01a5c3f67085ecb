"""The replay: frames are sampled, survive the process, and are verified when reopened."""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pgdm.errors import CheckpointError, PgdmError, RunError
from pgdm.rl.replay import Column, Replay
from pgdm.seeding import torch_stream

COLUMNS = {
    "obs": Column(torch.float16, (3,)),
    "terms": Column(torch.float32, (2,), ("near", "far")),
    "ended": Column(torch.bool),
}
FRAME = 3 * 2 + 2 * 4 + 1
"""Bytes of one frame."""


def replay(folder: Path | None, capacity: int = 64, batch: int = 16, **columns: Column) -> Replay:
    return Replay({**COLUMNS, **columns}, capacity, batch, torch_stream(0, "replay"), folder)


def frames(first: int, count: int, sign: float = 1.0) -> dict[str, Tensor]:
    """Return frames that hold their number; integers below 2048 are exact in float16."""
    number = sign * torch.arange(first, first + count).float()
    return {
        "obs": number[:, None] + torch.tensor([0.0, 0.5, 0.25]),
        "terms": number[:, None] + torch.tensor([0.1, 0.2]),
        "ended": number % 3 == 0,
    }


def content(where: Replay) -> dict[str, Tensor]:
    """Return all frames, read from the storage."""
    return {name: where._data.get(name)[: len(where)].clone() for name in where.columns}


def assert_holds(where: Replay, expected: dict[str, Tensor]) -> None:
    for name, column in COLUMNS.items():
        assert torch.equal(content(where)[name], expected[name].to(column.dtype)), name


def drawn(where: Replay) -> list[int]:
    """Return the numbers of the frames of one sample."""
    return where.sample()["obs"][:, 0].int().tolist()


@contextmanager
def one_line(kind: type[PgdmError], *said: str) -> Iterator[None]:
    with pytest.raises(kind) as caught:
        yield
    assert "\n" not in str(caught.value)
    for text in said:
        assert text in str(caught.value)


@pytest.mark.parametrize("kept", ["in memory", "in files"])
def test_complete_frames_are_sampled_in_single_precision(kept: str, tmp_path: Path) -> None:
    made = replay(None if kept == "in memory" else tmp_path / "replay")
    made.append(frames(0, 10))
    made.append(frames(10, 7))
    assert len(made) == 17
    sample = made.sample()
    assert sample.batch_size == torch.Size([16])
    number = sample["obs"][:, 0]
    expected = {
        name: torch.stack([column[int(n)] for n in number])
        for name, column in frames(0, 17).items()
    }
    assert sample["obs"].dtype == sample["terms"].dtype == torch.float32
    assert sample["ended"].dtype == torch.bool
    for name, column in expected.items():
        assert torch.equal(sample[name], column), name


def test_a_sample_is_a_uniform_draw_of_all_frames() -> None:
    made = replay(None, capacity=1000, batch=10_000)
    made.append(frames(0, 5))
    counts = torch.tensor(drawn(made)).bincount(minlength=5)
    assert len(counts) == 5
    # 2000 each, with a standard deviation of sqrt(10000 * 0.2 * 0.8) = 40.
    assert ((counts - 2000).abs() < 200).all()
    made.append(frames(5, 1))
    assert set(drawn(made)) == {0, 1, 2, 3, 4, 5}


def test_a_sample_is_drawn_from_the_given_stream_alone() -> None:
    def samples(seed: int, outside: int) -> list[list[int]]:
        torch.manual_seed(outside)
        made = Replay(COLUMNS, 64, 16, torch_stream(seed, "replay"))
        made.append(frames(0, 64))
        return [drawn(made) for _ in range(3)]

    before = torch.get_rng_state()
    made = replay(None)
    made.append(frames(0, 64))
    made.sample()
    assert torch.equal(torch.get_rng_state(), before)
    assert samples(0, outside=1) == samples(0, outside=2)
    assert samples(0, outside=1) != samples(1, outside=1)


def test_reopened_at_a_checkpoint_it_continues_identically(tmp_path: Path) -> None:
    straight, stopped = replay(tmp_path / "a"), replay(tmp_path / "b")
    for made in (straight, stopped):
        made.append(frames(0, 20))
        made.sample()
    state, stream = stopped.state_dict(), stopped._buffer._rng.get_state()
    stopped.append(frames(900, 30))  # after the checkpoint: discarded
    del stopped

    generator = torch_stream(5, "other")
    again = Replay(COLUMNS, 64, 16, generator, tmp_path / "b")
    again.load_state_dict(state)
    generator.set_state(stream)
    assert len(again) == 20
    for made in (straight, again):
        made.append(frames(20, 8))
    assert_holds(again, frames(0, 28))
    assert [drawn(again) for _ in range(5)] == [drawn(straight) for _ in range(5)]
    assert again.state_dict() == straight.state_dict()


def test_an_extended_run_keeps_its_frames(tmp_path: Path) -> None:
    made = replay(tmp_path, capacity=8)
    made.append(frames(0, 8))
    state = made.state_dict()
    longer = replay(tmp_path, capacity=20)
    longer.load_state_dict(state)
    longer.append(frames(8, 12))
    assert_holds(longer, frames(0, 20))
    assert (tmp_path / "obs.bin").stat().st_size == 20 * 6
    with one_line(CheckpointError, "8 frames", str(tmp_path), "4"):
        replay(tmp_path, capacity=4).load_state_dict(state)


@given(st.data())
@settings(max_examples=25)
def test_any_sequence_of_appends_and_restarts_keeps_the_frames(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made, saved, number = replay(Path(folder)), 0, 0
        state = made.state_dict()
        for _ in range(data.draw(st.integers(1, 8))):
            action = data.draw(st.sampled_from(["append", "save", "restart"]))
            if action == "append":
                count = data.draw(st.integers(1, 7))
                made.append(frames(number, count))
                number += count
            elif action == "save":
                state, saved = made.state_dict(), number
            else:
                made = replay(Path(folder))
                made.load_state_dict(state)
                number = saved
            assert len(made) == number
            assert_holds(made, frames(0, number))


APPENDING = """
import sys
from pathlib import Path
import torch
sys.path.insert(0, sys.argv[2])
from test_rl_replay import frames, replay
made = replay(Path(sys.argv[1]), capacity=1_000_000)
made.append(frames(0, 300))
torch.save(made.state_dict(), Path(sys.argv[1]) / "state")
print("saved", flush=True)
while True:
    made.append(frames(0, 50, sign=-1.0))
"""


def test_frames_saved_by_a_killed_process_are_there(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", APPENDING, str(tmp_path), str(Path(__file__).parent)],
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"saved\n"
    time.sleep(random.uniform(0.0, 0.2))
    process.kill()
    process.communicate()
    made = replay(tmp_path, capacity=1_000_000)
    made.load_state_dict(torch.load(tmp_path / "state"))
    assert_holds(made, frames(0, 300))
    made.append(frames(300, 1))
    assert_holds(made, frames(0, 301))


# What goes wrong.


def test_a_full_replay_is_an_error_and_keeps_its_frames() -> None:
    made = replay(None, capacity=10)
    made.append(frames(0, 8))
    with one_line(RunError, "room for 10 frames", "full"):
        made.append(frames(8, 3))
    assert_holds(made, frames(0, 8))
    made.append(frames(8, 2))
    with one_line(RunError, "full"):
        made.append(frames(10, 1))
    assert_holds(made, frames(0, 10))


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a replay with 40 of 64 frames, and its state."""
    made = replay(tmp_path / "replay")
    made.append(frames(1, 40))
    return tmp_path / "replay", made.state_dict()


def test_a_truncated_file_is_refused(saved: tuple[Path, dict[str, Any]]) -> None:
    folder, state = saved
    os.truncate(folder / "terms.bin", 40 * 8 - 1)  # reopening pads the file with zeros
    with one_line(CheckpointError, str(folder), "40 frames", "column 'terms' differs", "cut"):
        replay(folder).load_state_dict(state)


def test_a_file_truncated_after_the_checkpoints_frames_is_accepted(
    saved: tuple[Path, dict[str, Any]],
) -> None:
    folder, state = saved
    os.truncate(folder / "terms.bin", 40 * 8)
    made = replay(folder)
    made.load_state_dict(state)
    assert_holds(made, frames(1, 40))


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize("where", [0, 39])
def test_an_altered_byte_is_detected(
    saved: tuple[Path, dict[str, Any]], name: str, where: int
) -> None:
    folder, state = saved
    with open(folder / f"{name}.bin", "r+b") as file:
        file.seek(where * COLUMNS[name].nbytes)
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 1]))
    with one_line(CheckpointError, str(folder), f"column '{name}' differs", "altered"):
        replay(folder).load_state_dict(state)


@pytest.mark.parametrize("removed", [["obs"], list(COLUMNS)])
def test_missing_files_are_an_error_and_an_earlier_state_can_still_be_tried(
    saved: tuple[Path, dict[str, Any]], removed: list[str]
) -> None:
    folder, state = saved
    for name in removed:
        (folder / f"{name}.bin").unlink()
    made = replay(folder)
    with one_line(
        CheckpointError, f"{folder} is gone (it lacks {removed[0]}.bin)", "keep_replay=true"
    ):
        made.load_state_dict(state)
    made.load_state_dict({"frames": 0, "crc32": dict.fromkeys(COLUMNS, 0)})
    made.append(frames(1, 40))
    replay(folder).load_state_dict(made.state_dict())


def test_a_replay_in_memory_cannot_be_resumed() -> None:
    made = replay(None)
    made.append(frames(1, 40))
    with one_line(CheckpointError, "memory does not hold the 40 frames"):
        replay(None).load_state_dict(made.state_dict())


def test_a_replay_of_another_run_is_refused(
    saved: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, state = saved
    other = replay(tmp_path / "other")
    other.append(frames(2, 40))
    with one_line(CheckpointError, "column 'obs' differs", "of another run"):
        replay(tmp_path / "other").load_state_dict(state)
    with one_line(CheckpointError, "column 'obs' differs", "of another run"):
        replay(folder, obs=Column(torch.float16, (4,))).load_state_dict(state)
    with one_line(CheckpointError, "gone (it lacks wrist.bin)"):
        replay(folder, wrist=Column(torch.float32)).load_state_dict(state)
    made = replay(folder)  # and the right one is still complete
    made.load_state_dict(state)
    assert_holds(made, frames(1, 40))


@contextmanager
def mounted(kind: str, folder: Path, options: str = "") -> Iterator[Path]:
    """Mount a file system in memory, or skip the test if that is not permitted."""
    folder.mkdir()
    line = ["mount", "-t", kind, *(["-o", options] if options else []), "pgdm-test", str(folder)]
    try:
        done = subprocess.run(line, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip(f"cannot mount {kind}: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_an_error_at_the_start_and_takes_no_room(tmp_path: Path) -> None:
    with mounted("tmpfs", tmp_path / "disk", "size=1m") as disk:
        free = os.statvfs(disk).f_bfree
        with one_line(RunError, "cannot reserve 0.0 GB", "No space left", "total_frames"):
            replay(disk / "replay", capacity=2**20 // FRAME + 1)
        assert list((disk / "replay").iterdir()) == []
        assert os.statvfs(disk).f_bfree == free
        made = replay(disk / "replay", capacity=2**19 // FRAME)
        made.append(frames(0, 100))
        state = made.state_dict()
        # A longer run has no room: the shorter one is untouched.
        sizes = {path: path.stat().st_size for path in (disk / "replay").iterdir()}
        with one_line(RunError, "No space left"):
            replay(disk / "replay", capacity=2**20 // FRAME + 1)
        assert {path: path.stat().st_size for path in (disk / "replay").iterdir()} == sizes
        made = replay(disk / "replay", capacity=2**19 // FRAME)
        made.load_state_dict(state)
        assert_holds(made, frames(0, 100))


def test_a_file_size_limit_is_an_error(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:  # Python ignores the signal that comes with it
        with one_line(RunError, "cannot reserve", str(tmp_path / "replay"), "File too large"):
            replay(tmp_path / "replay", capacity=10_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list((tmp_path / "replay").iterdir()) == []


def test_a_file_in_place_of_the_folder_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with one_line(RunError, "cannot reserve", str(tmp_path / "file" / "in" / "it")):
        replay(tmp_path / "file" / "in" / "it")


def test_a_file_system_that_cannot_reserve_is_filled_with_zeros(tmp_path: Path) -> None:
    with mounted("ramfs", tmp_path / "disk") as disk:  # as NFS before version 4.2
        made = replay(disk / "replay")
        made.append(frames(0, 30))
        state = made.state_dict()
        again = replay(disk / "replay", capacity=100)  # extending it keeps its frames
        again.load_state_dict(state)
        assert_holds(again, frames(0, 30))


def test_the_files_can_be_read_without_pgdm(tmp_path: Path) -> None:
    stored, shown = replay(tmp_path), frames(0, 5)
    stored.append(shown)
    about = json.loads((tmp_path / "columns.json").read_text())
    for name, column in about.items():
        whole = np.memmap(tmp_path / column["file"], column["dtype"], "r")
        seen = whole.reshape(-1, *column["shape"][1:])[:5]
        assert np.array_equal(seen, shown[name].to(COLUMNS[name].dtype).numpy())
    assert about["terms"]["entries"] == ["near", "far"]
