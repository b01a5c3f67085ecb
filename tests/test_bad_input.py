"""User errors and damaged files: a one-line error that helps, and no data lost."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import TINY, Outcome, command, process, unchanged
from pgdm.config.compose import compose
from pgdm.config.saved import save_config
from pgdm.rl.checkpoint import write_checkpoint

SLURM = ("-m", "seed=0", "hydra/launcher=slurm")


def assert_helps(outcome: Outcome, *said: str, code: int | None = None) -> None:
    """Check for one line of error, the exit code, and no traceback."""
    assert outcome.code != 0
    assert code is None or outcome.code == code
    assert len(outcome.errors) == 1, outcome.err
    assert "Traceback" not in outcome.err + outcome.out
    for text in said:
        assert text in outcome.errors[0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        # Names.
        (["task=hammer-use9"], ["unknown task 'hammer-use9'", "did you mean hammer-use1"]),
        (["hand=adriot"], ["unknown hand 'adriot'", "adroit"]),
        (["seeed=1"], ["unknown key 'seeed'", "did you mean seed"]),
        (["algo.lr=1e-4"], ["unknown key 'algo.lr'", "pgdm-run --help"]),
        (["+algo.lr=1e-4"], ["unknown key of 'algo' 'lr'", "learning_rate"]),
        (
            ["method.curriculum.ramp_frames=9"],
            ["'method.curriculum.ramp_frames' is a setting of method=curriculum or full only"],
        ),
        (
            ["method=full", "method.imitation=null", "method.imitation.weight=2"],
            ["'method.imitation.weight' cannot be set, as method.imitation is null here"],
        ),
        (
            ["algo=sac", "algo.minibatch_size=8"],
            ["'algo.minibatch_size' is a setting of algo=ppo or ppo_fast or ppo_wide only"],
        ),
        (
            ["algo=ppo_fast", "algo.critics=2"],
            ["'algo.critics' is a setting of algo=sac or sac_wide only"],
        ),
        (["algo=sac", "algo.critcs=2"], ["unknown key 'algo.critcs'; did you mean algo.critics"]),
        (["pregrap=mined"], ["unknown key 'pregrap'", "pregrasp"]),
        (["+experiment=quick"], ["unknown experiment 'quick'", "quickstart"]),
        (["experiment=quickstart"], ["+experiment=NAME"]),
        # Types and values.
        (["total_frames=abc"], ["total_frames: 'abc' is not an integer"]),
        (["num_envs=1.5"], ["num_envs: 1.5 is not an integer"]),
        (["num_envs=-4"], ["num_envs is -4; it must be at least 1"]),
        (["eval.episodes=0"], ["eval.episodes is 0"]),
        (["seed=null"], ["seed: null is not allowed here; it must be an integer"]),
        (["algo.gamma=nan"], ["algo.gamma: nan is not a finite number"]),
        (["algo.hidden=256"], ["algo.hidden: 256 is not a list"]),
        (["offline=maybe"], ["offline: 'maybe' is not true or false"]),
        (["run_dir=7"], ["""write run_dir="'7'" to mean text"""]),
        (["resume=yes"], ["unknown resume value 'yes'", "auto, must, never"]),
        (["algo.minibatch_size=300"], ["300", "4096", "num_envs 32", "such as 256"]),
        (["algo.learner=foo"], ["unknown algo.learner 'foo'; valid: ppo, sac"]),
        (["algo=sac", "algo.target_rate=2"], ["algo.target_rate is 2.0", "between 0 and 1"]),
        (["algo=sac", "algo.critics=0"], ["algo.critics is 0", "at least 1"]),
        (["algo=sac", "algo.warmup_steps=0"], ["algo.warmup_steps is 0", "at least 1"]),
        (["algo=sac", "algo.reward_scale=0"], ["algo.reward_scale is 0.0", "above 0"]),
        (["algo=sac", "algo.adam_betas=[0.9]"], ["algo.adam_betas is [0.9]", "two numbers"]),
        (["keep_replay=maybe"], ["keep_replay: 'maybe' is not true or false"]),
        (["device=tpu"], ["unknown device 'tpu'; did you mean cpu?"]),
        # Form.
        (["seed"], ["cannot read 'seed'; write key=value"]),
        (["seed=1,2"], ["add -m"]),
        (["task=[duck-lift,cup-pour1]"], ["-m task=duck-lift,cup-pour1"]),
        (["seed=[1"], ["cannot read 'seed=[1'"]),
        (["--ofline"], ["unknown flag '--ofline'", "did you mean --offline"]),
        (["--cfg"], ["--cfg needs a value: job or hydra or all"]),
        (["--config-dir", "nowhere"], ["--config-dir 'nowhere' is not a folder"]),
        (["-m", "seed=0,1", "num_envs=32,33"], ["num_envs 33", "in the run", "none was started"]),
        (["-m", "seed=0,1", "run_dir=a"], ["would share run_dir '", "run_dir=out/${seed}"]),
        (["-m", "task=duck-lift,duck-lft"], ["unknown task or suite 'duck-lft'", "duck-lift"]),
        # Sweeps.
        (["task=tcdm30"], ["tcdm30 is a suite of 30 tasks", "pgdm-run -m task=tcdm30"]),
        (["task=dhand-*"], ["pgdm-run -m 'task=dhand-*'"]),
        (["task=tcdm30,duck-lift"], ["add -m"]),
        (["task=tcdm31"], ["unknown task 'tcdm31'; did you mean tcdm30"]),
        (["suite=quick6"], ["pgdm-run -m task=quick6"]),
        (["-m", "task=tcdm31"], ["unknown task or suite 'tcdm31'; did you mean tcdm30"]),
        (["-m", "task=dhand,-dhand-*"], ["'task=dhand,-dhand-*' leaves nothing to run"]),
        (["-m", "seed=interval(0,1)"], ["is an interval; list the values to try"]),
        (["-m", "seed=0,1", "seeed=1"], ["unknown key 'seeed'; did you mean seed"]),
        (["-m", "task=tcdm30", "seeed=1"], ["unknown key 'seeed'; did you mean seed"]),
        (["-m", "algo=ppo,pppo"], ["unknown algo 'pppo'; did you mean ppo"]),
        (["-m", "seed=0", "sweep.nmae=x"], ["unknown key 'sweep.nmae'; did you mean sweep.name"]),
        (["-m", "seed=0", "sweep.name=a/b"], ["sweep.name 'a/b' is not valid"]),
        (["-m", "seed=0", "sweep.max_attempts=0"], ["sweep.max_attempts is 0", "at least 1"]),
        (["-m", "seed=0", "sweep.detach=maybe"], ["sweep.detach: 'maybe' is not true or false"]),
        (["-m", "seed=0", "hydra.launcher.max_jobs=-1"], ["max_jobs is -1", "at least 0"]),
        (["-m", "seed=0", "hydra.launcher.memory_per_job_gb=0"], ["must be above 0"]),
        (["-m", "seed=0", "hydra/launcher=basic"], ["unknown hydra/launcher", "local, slurm"]),
        (["-m", "seed=0", "hydra/launcher=slrm"], ["unknown hydra/launcher 'slrm'"]),
        ([*SLURM, "hydra.launcher.time_min=0"], ["time_min is 0", "at least 1"]),
        ([*SLURM, "hydra.launcher.time_min=2"], ["signal_delay_s is 120", "only 2 minutes"]),
        ([*SLURM, "hydra.launcher.cores_per_job=0"], ["cores_per_job is 0", "at least 1"]),
        ([*SLURM, "hydra.launcher.partition=1"], ["partition: 1 is not text"]),
        ([*SLURM, "hydra.launcher.queue=gpu"], ["unknown key 'hydra.launcher.queue'"]),
        ([*SLURM, "hydra.launcher.setup=module"], ["'module' is not a list"]),
        (["-m", "seed=0", "hydra/sweeper=basic"], ["unknown hydra/sweeper", "valid: pgdm"]),
        (["+sweep=validate"], ["unknown sweep file 'validate'; did you mean validate_tcdm50"]),
        (["sweep=validate_tcdm50"], ["with a plus: +sweep=validate_tcdm50"]),
        (["+sweep=sim2real", "+sweep=sim2real"], ["+sweep is given 2 times"]),
        (["+sweep=sim2real", "budget=smok"], ["unknown budget 'smok'; did you mean smoke"]),
        (["sweep.dry_run=true"], ["'sweep.dry_run=true' is for sweeps; add -m"]),
        (["sweep.name=x"], ["'sweep.name=x' is for sweeps; add -m"]),
        (["hydra.launcher.max_jobs=2"], ["is for sweeps; add -m"]),
    ],
)
def test_wrong_settings(tmp_path: Path, arguments: list[str], said: list[str]) -> None:
    assert_helps(command("pgdm-run", *arguments), *said, code=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said", "code"),
    [
        (["evla"], ["No such command 'evla'", "pgdm --help"], 2),
        (["--frobnicate"], ["No such option: --frobnicate"], 2),
        (["eval"], ["Missing argument 'POLICY'"], 2),
        (["eval", "nowhere"], ["no run folder or checkpoint 'nowhere'", "pgdm runs"], 1),
        (["eval", "."], ["holds no run: it has no config.yaml"], 1),
        (["eval", ".", "--episodes", "0"], ["--episodes"], 2),
        (["view", "hammer-use9"], ["unknown task 'hammer-use9'", "hammer-use1"], 2),
        (["view", "duck-lift", "--pregrasp", "mimed"], ["unknown pregrasp 'mimed'", "mined"], 2),
        (["view", "duck-lift", "--video", "a.gif"], ["a name that ends in .mp4"], 2),
        (["view", "duck-lift", "--offline"], ["--offline forbids", "pgdm assets fetch"], 1),
        (["assets", "import", "nowhere"], ["nowhere"], 1),
        (["assets", "show", "hammer-use9"], ["library", "is empty", "pgdm assets fetch"], 1),
        (["runs", "nowhere"], ["nowhere"], 1),
    ],
)
def test_wrong_commands(arguments: list[str], said: list[str], code: int | None) -> None:
    assert_helps(command("pgdm", *arguments), *said, code=code)


@pytest.mark.parametrize("task", ["hammer-use1", "door-open"])
def test_an_empty_library_offline(tmp_path: Path, task: str) -> None:
    outcome = command("pgdm-run", "--offline", f"task={task}", *TINY)
    assert_helps(outcome, f"task '{task}'", "pgdm assets import PATH", code=1)
    assert not (tmp_path / "runs").exists()


def test_broken_settings_of_your_own(tmp_path: Path) -> None:
    (tmp_path / "mine" / "algo").mkdir(parents=True)
    (tmp_path / "mine" / "algo" / "a.yaml").write_text("gamma: [1\n")
    (tmp_path / "mine" / "algo" / "b.yaml").write_text("gamma: 0.9\n")
    with unchanged(tmp_path):
        broken = command("pgdm-run", "--config-dir", "mine", "algo=a")
        assert_helps(broken, "not valid YAML", "a.yaml", code=2)
        lacking = command("pgdm-run", "--config-dir", "mine", "algo=b")
        assert_helps(lacking, "missing algo.learner; one of ppo, sac", code=2)
    named = Path("mine", "experiment", "fast.yaml")
    (tmp_path / named).parent.mkdir()
    (tmp_path / named).write_text("seed: 7\n")
    clash = command("pgdm-run", "--config-dir", "mine", "+experiment=fast")
    assert_helps(clash, f"{named} has the name of pgdm's", code=2)


# Run folders.


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """Return the folder of a run that was started but has no checkpoint."""
    folder = tmp_path / "run"
    save_config(compose([*TINY, f"run_dir={folder}"]), folder)
    return folder


def test_a_file_in_place_of_the_run_folder(tmp_path: Path) -> None:
    file = tmp_path / "run"
    file.write_text("precious")
    with unchanged(tmp_path):
        for place in ("run", "run/inside"):
            outcome = command("pgdm-run", "--offline", *TINY, f"run_dir={place}")
            assert_helps(outcome, "run", code=1)


def test_a_folder_with_other_content(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("precious")
    with unchanged(tmp_path):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=thesis")
        assert_helps(outcome, "'thesis' is not empty and holds no run", "another run_dir", code=1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["seed=3"], ["holds another experiment", "seed: 0 -> 3", "another run_dir"]),
        (["algo.clip=0.1", "seed=3"], ["algo.clip: 0.2 -> 0.1; seed: 0 -> 3"]),
        (["total_frames=16"], ["total_frames: 32 -> 16 (it may only grow)"]),
        (["resume=never"], ["resume=never", "another run_dir"]),
    ],
)
def test_changed_settings_for_an_existing_run(
    run_dir: Path, arguments: list[str], said: list[str]
) -> None:
    with unchanged(run_dir):
        outcome = command("pgdm-run", "--offline", *TINY, f"run_dir={run_dir}", *arguments)
        assert_helps(outcome, *said, code=1)


def test_nothing_to_resume(tmp_path: Path) -> None:
    outcome = command("pgdm-run", "--offline", *TINY, "run_dir=none", "resume=must")
    assert_helps(outcome, "'none' holds no run and resume=must", code=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "damaged"),
        (b"seed: [0", "damaged"),
        (b"\xff\xfe\x00", "damaged"),
        (b"format: 7\nseed: 0\n", "format 7, this pgdm reads up to 1; install a newer pgdm"),
        (b"format: 1\nseed: 0\n", "missing task"),
        (b"!!python/object/apply:os.system [touch hacked]\n", "damaged"),
    ],
)
def test_a_damaged_config(run_dir: Path, content: bytes, said: str) -> None:
    file = run_dir / "config.yaml"
    file.write_bytes(content)
    with unchanged(run_dir):
        for arguments in (
            ("pgdm-run", "--offline", *TINY, f"run_dir={run_dir}"),
            ("pgdm", "eval", str(run_dir)),
        ):
            outcome = command(*arguments)
            if arguments[0] == "pgdm-run" or "no checkpoint" not in outcome.err:
                assert_helps(outcome, str(file), said, code=2)
    assert not Path("hacked").exists()


# Checkpoints.


class Hostile:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (os.system, ("touch hacked",))


def checkpoint_in(run_dir: Path) -> Path:
    """Return the path of the run's checkpoint."""
    (run_dir / "checkpoints").mkdir()
    return run_dir / "checkpoints" / "frames_000000000016.ckpt"


def test_no_checkpoint_yet(run_dir: Path) -> None:
    with unchanged(run_dir):
        assert_helps(command("pgdm", "eval", str(run_dir)), "has no checkpoint yet", code=1)


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "flipped", "pickle", "torch", "other"])
def test_a_damaged_or_foreign_checkpoint(run_dir: Path, kind: str) -> None:
    file = checkpoint_in(run_dir)
    write_checkpoint(file, {"weights": torch.zeros(1000)})
    good = file.read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    content = {
        "empty": b"",
        "text": b"hello",
        "cut": good[:-100],
        "flipped": bytes(flipped),
        "pickle": pickle.dumps(Hostile()),
        "other": good,
    }
    if kind == "torch":
        torch.save({"learner": Hostile()}, file)
    else:
        file.write_bytes(content[kind])
    with unchanged(run_dir):
        for target in (run_dir, file):
            assert_helps(
                command("pgdm", "eval", str(target), "--offline"), str(file.parent), code=1
            )
    assert not Path("hacked").exists()


def test_a_checkpoint_without_its_run(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "lost" / "best.ckpt", {"frames": 0})
    with unchanged(tmp_path):
        outcome = command("pgdm", "eval", "lost/best.ckpt")
        assert_helps(outcome, "is in no run folder", code=1)


# The machine.


def test_standard_output_on_a_full_disk() -> None:
    code = "import sys; from pgdm.cli.run import main; sys.exit(main(['--help']))"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert_helps(Outcome(done.returncode, "", done.stderr), "the disk is full; make room", code=1)


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    """Return a folder that nobody can write to, not even root."""
    folder = tmp_path / "read-only"
    folder.mkdir()
    if os.getuid() != 0:
        folder.chmod(0o500)
        yield folder
        folder.chmod(0o700)
        return
    mount = ["mount", "-t", "tmpfs", "-o", "ro,size=64k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("root without permission to mount: nothing is read-only")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


# With a real library.


@pytest.fixture
def home(library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set ``PGDM_HOME`` to a copy of the library with all tasks, and return its path."""
    copy = tmp_path / "home"
    # Hard links: files to be damaged are replaced, never written to.
    shutil.copytree(library_home, copy, copy_function=os.link)
    monkeypatch.setenv("PGDM_HOME", str(copy))
    return copy


def replace_file(file: Path, content: bytes) -> None:
    """Replace a link to a shared file by a file with other content."""
    file.unlink()
    file.write_bytes(content)


def test_a_run_folder_that_cannot_be_written(home: Path, read_only: Path) -> None:
    outcome = command("pgdm-run", "--offline", *TINY, f"run_dir={read_only / 'run'}")
    assert_helps(outcome, f"cannot write run_dir '{read_only / 'run'}'", code=1)


def test_a_video_that_cannot_be_written(home: Path, read_only: Path) -> None:
    outcome = command("pgdm", "view", "duck-lift", "--video", str(read_only / "a.mp4"))
    assert_helps(outcome, str(read_only / "a.mp4"), code=1)


def test_no_space_for_a_checkpoint(home: Path, tmp_path: Path) -> None:
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))"
    outcome = process("pgdm-run", "--offline", *TINY, "run_dir=run", before=limit)
    assert_helps(outcome, "cannot write a checkpoint", "make room", code=1)
    assert (tmp_path / "run" / "config.yaml").exists()
    resumed = command("pgdm-run", "--offline", *TINY, "run_dir=run")
    assert resumed.code == 0, resumed.err


def test_a_run_resumes_after_the_disk_was_full(home: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)]
    if os.getuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs permission to mount a small disk")
    try:
        outcome = command("pgdm-run", "--offline", *TINY, f"run_dir={disk / 'run'}")
        assert_helps(outcome, "make room", code=1)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        resumed = command("pgdm-run", "--offline", *TINY, f"run_dir={disk / 'run'}")
        assert resumed.code == 0, resumed.err
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x03\x04 cut off",
        b"no archive",
        pickle.dumps(Hostile()),
    ],
)
def test_a_damaged_motion(home: Path, tmp_path: Path, content: bytes) -> None:
    file = home / "library" / "checkout" / "motions" / "hammer-use1.npz"
    replace_file(file, content)
    with unchanged(home):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(outcome, str(file), code=1)
    assert not Path("hacked").exists()
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize("change", ["object", "nan", "shape", "quaternion"])
def test_a_motion_with_impossible_content(home: Path, change: str) -> None:
    file = home / "library" / "checkout" / "motions" / "hammer-use1.npz"
    arrays = dict(np.load(file))
    if change == "object":
        arrays["start_mined_qpos"] = np.array([Hostile()], dtype=object)
    elif change == "nan":
        arrays["object_translation"][3, 1] = np.nan
    elif change == "shape":
        arrays["object_translation"] = arrays["object_translation"][:, :2]
    else:
        arrays["object_orientation"][5] *= 2
    file.unlink()
    np.savez(file, allow_pickle=True, **arrays)
    with unchanged(home):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(outcome, "hammer-use1", code=1)
    assert not Path("hacked").exists()


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format": 99}'])
def test_a_damaged_manifest(home: Path, content: bytes) -> None:
    file = home / "library" / "checkout" / "manifest.json"
    replace_file(file, content)
    with unchanged(home):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(outcome, "manifest.json", code=1)


@pytest.mark.parametrize("name", ["objects/hammer/object.xml", "hands/adroit/hand.xml"])
def test_a_missing_model(home: Path, name: str) -> None:
    file = home / "library" / "checkout" / name
    file.unlink()
    with unchanged(home):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(outcome, file.name, code=1)


def test_no_opengl(home: Path) -> None:
    env = {"MUJOCO_GL": "disable"}
    view = process("pgdm", "view", "duck-lift", "--video", "a.mp4", env=env)
    assert_helps(view, "MUJOCO_GL=disable; unset it", code=1)
    assert not Path("a.mp4").exists()
    run = process("pgdm-run", "--offline", *TINY, "eval.video=true", "run_dir=run", env=env)
    assert (run.code, run.errors) == (0, [])  # a policy without a video is still a result
    assert "no video" in run.err


def test_no_screen(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert_helps(command("pgdm", "view", "duck-lift"), "no screen", "--video FILE", code=1)


def test_a_start_that_is_not_stored(home: Path) -> None:
    outcome = command("pgdm-run", "--offline", *TINY, "pregrasp=learned", "run_dir=run")
    assert_helps(outcome, "'learned'", "mined", "planned", code=2)


def test_a_hand_that_does_not_fit_the_stored_start(home: Path) -> None:
    wrong = command("pgdm-run", "--offline", *TINY, "hand=dhand", "pregrasp=mined", "run_dir=run")
    assert_helps(wrong, "hammer-use1", "pregrasp=planned", code=2)
    # A start that fits is computed from the human hand, which this library lacks.
    alone = command("pgdm-run", "--offline", *TINY, "hand=dhand", "run_dir=run")
    assert_helps(alone, "hammer-use1", "pgdm assets fetch", code=1)


def test_a_checkpoint_of_another_task(home: Path, tmp_path: Path) -> None:
    other = command("pgdm-run", "--offline", *TINY, "task=dhand-cup", "run_dir=other")
    assert other.code == 0, other.err
    save_config(compose([*TINY, "run_dir=run"]), tmp_path / "run")
    shutil.copytree(tmp_path / "other" / "checkpoints", tmp_path / "run" / "checkpoints")
    with unchanged(tmp_path / "run" / "checkpoints", tmp_path / "run" / "config.yaml"):
        evaluated = command("pgdm", "eval", "run", "--offline")
        assert_helps(evaluated, "was trained with", "another run_dir", code=1)
        resumed = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(resumed, "run", code=1)


def test_every_checkpoint_of_a_run_is_damaged(home: Path, tmp_path: Path) -> None:
    assert command("pgdm-run", "--offline", *TINY, "run_dir=run").code == 0
    for file in (tmp_path / "run" / "checkpoints").iterdir():
        file.write_bytes(file.read_bytes()[:1000])
    longer = [*TINY, "run_dir=run", "total_frames=64"]
    with unchanged(tmp_path / "run" / "checkpoints", tmp_path / "run" / "config.yaml"):
        outcome = command("pgdm-run", "--offline", *longer)
        assert_helps(outcome, "checkpoints", "start anew in another run_dir", code=1)


@pytest.mark.parametrize("name", ["objects/hammer/object.xml", "hands/adroit/hand.xml"])
def test_a_damaged_model(home: Path, name: str) -> None:
    file = home / "library" / "checkout" / name
    replace_file(file, b"<mujoco><body></mujoco>")
    with unchanged(home):
        outcome = command("pgdm-run", "--offline", *TINY, "run_dir=run")
        assert_helps(outcome, file.name, code=1)


def test_an_unknown_mujoco_gl(home: Path) -> None:
    view = process("pgdm", "view", "duck-lift", "--video", "a.mp4", env={"MUJOCO_GL": "vulkan"})
    assert (view.code, view.errors) == (0, []), view.err
    assert "MUJOCO_GL is 'vulkan'" in view.err and "valid: egl, osmesa, glfw" in view.err
    assert Path("a.mp4").exists()
