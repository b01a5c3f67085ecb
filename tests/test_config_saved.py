from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from pgdm.config.compose import compose
from pgdm.config.identity import ADDED_LATER, changes_result, identity
from pgdm.config.saved import check_run_dir, load_config, save_config
from pgdm.errors import ConfigError, PgdmError, RunError
from pgdm.runs.config_file import dotted
from pgdm.runs.files import CONFIG

STUDY = Path(__file__).resolve().parents[1] / "benchmark" / "results" / "study" / "runs"


@pytest.mark.parametrize(
    "overrides",
    [[], ["+experiment=quickstart"], ["task=hammer-strike"], ["task=dmanus-sim2real", "obs=paper"]],
)
def test_what_was_saved_is_read_back(tmp_path: Path, overrides: list[str]) -> None:
    cfg = compose([*overrides, f"run_dir={tmp_path}"])
    file = save_config(cfg, tmp_path)
    assert file.name == CONFIG
    assert load_config(tmp_path) == cfg
    assert list(tmp_path.iterdir()) == [file]


numbers = st.floats(min_value=1e-12, max_value=1e12)


@given(numbers, numbers, st.text(min_size=1).filter(str.strip))
@example(1.0, 1.0, "a\x85b\u2028")  # line breaks to YAML, unless they are escaped
def test_numbers_and_text_survive_to_the_bit(rate: float, scale: float, text: str) -> None:
    cfg = compose()
    algo = dataclasses.replace(cfg.algo, learning_rate=rate)
    reward = dataclasses.replace(cfg.method.reward, tracking_scale=scale)
    method = dataclasses.replace(cfg.method, reward=reward)
    cfg = dataclasses.replace(cfg, algo=algo, method=method, budget=text)
    with tempfile.TemporaryDirectory() as folder:
        save_config(cfg, folder)
        assert load_config(folder) == dataclasses.replace(cfg, run_dir=folder)


def test_a_moved_run_knows_where_it_is(tmp_path: Path) -> None:
    save_config(compose(["run_dir=before"]), tmp_path / "before")
    (tmp_path / "before").rename(tmp_path / "after")
    moved = load_config(tmp_path / "after")
    assert moved.run_dir == str(tmp_path / "after")
    assert identity(moved) == identity(compose())


def test_saving_replaces_the_file_as_a_whole(tmp_path: Path) -> None:
    save_config(compose(), tmp_path)
    save_config(compose(["total_frames=60_000_000"]), tmp_path)
    assert load_config(tmp_path).total_frames == 60_000_000


def test_no_run_here(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"holds no run: it has no config.yaml"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed: 0", "seed: x", "config.yaml: seed: 'x' is not an integer; restore the file"),
        ("seed: 0", "sed: 0", "unknown key 'sed'; did you mean seed"),
        ("seed: 0\n", "", "missing seed"),
        ("  clip: 0.2", "  clip: 0", "algo.clip is 0.0; it must be above 0"),
        ("format: 1", "format: 2", "has format 2, this pgdm reads up to 1; install a newer pgdm"),
        ("format: 1\n", "", "no valid format number"),
        ("seed: 0", "seed: [0", "is damaged"),
        ("seed: 0", "seed: !!python/object/apply:os.system [ls]", "is damaged"),
    ],
)
def test_an_edited_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = save_config(compose(), tmp_path)
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(tmp_path)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=200))
def test_any_file_is_read_or_refused(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / CONFIG).write_bytes(content)
        with pytest.raises(PgdmError):
            load_config(folder)


@pytest.mark.parametrize("cut", [0, 1, 100, 1000])
def test_a_truncated_file_is_refused(tmp_path: Path, cut: int) -> None:
    file = save_config(compose(), tmp_path)
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        load_config(tmp_path)


def test_a_run_made_on_a_gpu_can_be_looked_at_without_one(tmp_path: Path) -> None:
    save_config(dataclasses.replace(compose(), device="cuda"), tmp_path)
    assert load_config(tmp_path).device == "cuda"


def test_a_run_older_than_a_key_is_read_and_is_the_same_experiment(tmp_path: Path) -> None:
    cfg = compose([f"run_dir={tmp_path}"])
    file = save_config(cfg, tmp_path)
    plain = yaml.safe_load(file.read_text())
    for key in ADDED_LATER:
        group, _, name = key.rpartition(".")
        (plain[group] if group else plain).pop(name, None)  # keys of SAC are absent
    file.write_text(yaml.safe_dump(plain))
    assert load_config(tmp_path) == cfg
    check_run_dir(compose([f"run_dir={tmp_path}"]))
    changed = compose([f"run_dir={tmp_path}", "sim.object_mass=published"])
    with pytest.raises(RunError, match=r"sim\.object_mass: volume -> published"):
        check_run_dir(changed)


@pytest.mark.parametrize("setting", ["pgdm-residual", "distance_15cm-absolute"])
def test_stored_runs_keep_their_identity(setting: str) -> None:
    folder = STUDY / setting / "door-open"
    flat = dotted(yaml.safe_load((folder / CONFIG).read_text()))
    del flat["format"]
    assert identity(load_config(folder)) == {k: v for k, v in flat.items() if changes_result(k)}
