from __future__ import annotations

import hashlib
import io
import logging
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pgdm.errors import CheckpointError
from pgdm.rl import checkpoint
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint, write_checkpoint

STATE = {
    "weights": {"a": torch.arange(5.0)},
    "name": "x",
    "numbers": [1, 2.5, None, True, 2**80],
    "generator": torch.Generator().get_state(),
}


def saved(folder: Path, *frames: int, keep_last: int = 5) -> CheckpointFolder:
    made = CheckpointFolder(folder / "checkpoints", keep_last)
    for count in frames:
        made.save({"frames": count}, count)
    return made


def test_a_state_survives_writing_and_reading(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "new" / "a.ckpt", STATE)
    state = read_checkpoint(tmp_path / "new" / "a.ckpt")
    assert torch.equal(state["weights"]["a"], STATE["weights"]["a"])
    assert torch.equal(state["generator"], STATE["generator"])
    assert (state["name"], state["numbers"]) == (STATE["name"], STATE["numbers"])
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.ckpt"]


@pytest.mark.parametrize("keep", [0, 10, -1, -40])
def test_a_truncated_file_is_refused(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, STATE)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"a\.ckpt.*(cut off|damaged)"):
        read_checkpoint(path)


def test_a_flipped_bit_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, STATE)
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(CheckpointError, match="checksum"):
        read_checkpoint(path)


class Hostile:
    """Would create a file when unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.trace),)


def test_a_file_that_would_run_code_is_refused_and_runs_nothing(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    torch.save({"a": Hostile(tmp_path / "trace")}, buffer)
    payload = buffer.getvalue()
    path = tmp_path / "a.ckpt"
    path.write_bytes(payload + checkpoint._MAGIC + hashlib.sha256(payload).digest())
    with pytest.raises(CheckpointError, match="refused"):
        read_checkpoint(path)
    path.write_bytes(pickle.dumps(Hostile(tmp_path / "trace")))
    with pytest.raises(CheckpointError, match="not a pgdm checkpoint"):
        read_checkpoint(path)
    assert not (tmp_path / "trace").exists()


def test_a_state_that_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="more than tensors and plain values"):
        write_checkpoint(tmp_path / "a.ckpt", {"path": Path("x")})
    assert not list(tmp_path.iterdir())


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"cannot read checkpoint .*a\.ckpt: No such file"):
        read_checkpoint(tmp_path / "a.ckpt")


def test_the_newest_and_the_best_are_kept(tmp_path: Path) -> None:
    folder = saved(tmp_path, keep_last=2)
    folder.save_best({"frames": 0})
    for frames in (0, 4096, 8192, 1_000_000):
        folder.save({"frames": frames}, frames)
    assert [p.name for p in folder.all()] == [
        "frames_000000008192.ckpt",
        "frames_000001000000.ckpt",
    ]
    assert read_checkpoint(folder.best) == {"frames": 0}
    assert folder.latest() == {"frames": 1_000_000}


def test_a_damaged_newest_is_skipped_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = saved(tmp_path, 1, 2, 3)
    for path in folder.all()[1:]:
        path.write_bytes(path.read_bytes()[:100])
    with caplog.at_level(logging.WARNING):
        assert folder.latest() == {"frames": 1}
    assert len(caplog.records) == 2
    assert "frames_000000000003.ckpt" in caplog.text
    assert "the checkpoint before it" in caplog.text


def test_a_damaged_newest_does_not_displace_good_ones(tmp_path: Path) -> None:
    folder = saved(tmp_path, 100, 200, keep_last=2)
    (folder.folder / "frames_000000000200.ckpt").write_bytes(b"cut")
    assert folder.latest() == {"frames": 100}
    folder.save({"frames": 150}, 150)
    folder.save({"frames": 180}, 180)
    assert [path.name for path in folder.all()] == [
        "frames_000000000150.ckpt",
        "frames_000000000180.ckpt",
    ]
    assert folder.latest() == {"frames": 180}


def test_no_readable_checkpoint_is_an_error_but_no_checkpoint_is_not(tmp_path: Path) -> None:
    folder = saved(tmp_path, 1)
    folder.all()[0].write_bytes(b"")
    with pytest.raises(
        CheckpointError, match=r"of 1 checkpoint in .* none can be used .*another run_dir"
    ):
        folder.latest()
    assert CheckpointFolder(tmp_path / "nothing", 2).latest() is None


DISK_FULL = """
import resource, sys
from pathlib import Path
import torch
from pgdm.errors import CheckpointError
from pgdm.rl.checkpoint import CheckpointFolder
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))  # as on a full disk
folder = CheckpointFolder(Path(sys.argv[1]), 1)
folder.save({"small": torch.zeros(10)}, 1)
try:
    folder.save({"large": torch.zeros(1_000_000)}, 2)
except CheckpointError as error:
    print(error)
print(sorted(p.name for p in Path(sys.argv[1]).iterdir()), list(folder.latest()))
"""


def test_a_full_disk_is_one_line_and_keeps_earlier_checkpoints(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", DISK_FULL, str(tmp_path)], capture_output=True, text=True, check=True
    )
    message, listing = done.stdout.splitlines()
    assert message.startswith(f"cannot write a checkpoint of 4.0 MB to {tmp_path} (")
    assert "MB free): File too large; make room" in message
    assert listing == "['frames_000000000001.ckpt'] ['small']"


def test_a_folder_that_cannot_be_created(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match=r"cannot write .*: (Not a dir|File ex)"):
        CheckpointFolder(tmp_path / "file", 1).save(STATE, 1)


def test_leftovers_of_a_killed_writer_are_deleted(tmp_path: Path) -> None:
    folder = saved(tmp_path, 1)
    stale = folder.folder / ".tmp-123-frames_000000000002.ckpt"
    stale.write_bytes(b"half")
    assert folder.latest() == {"frames": 1}
    folder.save({"frames": 2}, 2)
    assert not stale.exists()
