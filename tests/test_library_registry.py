"""The fetched package gives the same scenes as a checkout."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

import pgdm.library
from conftest import CACHE, DOWNLOADS
from library_trees import snapshot
from pgdm.errors import CorruptAssetError, LibraryError
from pgdm.library import Library, fetch_registry, open_library
from pgdm.library.checks.compare import compare, compare_options
from pgdm.library.checks.compiled import compiled
from pgdm.library.checks.explain import differences, explain
from pgdm.library.checks.verify import damaged
from pgdm.library.robohive import fill as registry
from pgdm.library.robohive.fill import PACKAGE
from pgdm.library.robohive.package_index import Package
from pgdm.library.tasks import MOCAP_TASKS

ROOT = os.environ.get("PGDM_TCDM_ROOT")
NOT_IN_PACKAGE = {"dapg_hammer", "door", "nail"}


def _wanted(name: str) -> bool:
    return bool(registry._WANTED.fullmatch(name))


def test_only_data_is_unpacked() -> None:
    sims = "mj_envs/sims"
    assert _wanted(f"{sims}/object_sim/hammer/contact0.stl")
    assert _wanted(f"{sims}/Adroit/resources/chain.xml")
    assert _wanted("mj_envs/envs/tcdm/assets/data/Adroit_cup_pour.npz")
    assert _wanted("robohive-0.4.0.dist-info/LICENSE")
    for name in (
        "mj_envs/envs/tcdm/track.py",
        f"{sims}/object_sim/hammer/setup.py",
        f"{sims}/object_sim/../../x.stl",
        f"{sims}/object_sim/hammer/../x.stl",
        f"../{sims}/object_sim/hammer/contact0.stl",
        "mj_envs/envs/tcdm/assets/tmp_data/Adroit_hammer_use_1.npz",
        f"{sims}/franka_sim/franka.xml",
    ):
        assert not _wanted(name), name


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, bytes]], Path]:
    """Return what puts a wheel that is not the real one where the real one is looked for."""

    def put(members: dict[str, bytes]) -> Path:
        path = tmp_path / "downloads" / PACKAGE.file
        path.parent.mkdir(exist_ok=True)
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        package = Package(PACKAGE.name, PACKAGE.version, PACKAGE.file, digest, len(data))
        monkeypatch.setattr(registry, "PACKAGE", package)
        return path.parent

    return put


def test_a_wheel_without_the_models_is_refused_by_name(
    fake: Callable[[dict[str, bytes]], Path], tmp_path: Path
) -> None:
    downloads = fake({"robohive-0.4.0.dist-info/LICENSE": b"Apache"})
    with pytest.raises(CorruptAssetError, match=r"white_marble_tile2\.png' is missing"):
        fetch_registry(tmp_path / "library", True, downloads=downloads)
    assert open_library(tmp_path / "library").tasks() == {}
    assert snapshot(tmp_path / "library") == {}


def test_a_wheel_that_is_not_the_expected_one_is_never_opened(tmp_path: Path) -> None:
    (tmp_path / PACKAGE.file).write_bytes(b"PK something else")
    with pytest.raises(LibraryError, match="--offline forbids fetching"):
        fetch_registry(tmp_path / "library", True, downloads=tmp_path)


@pytest.fixture(scope="module")
def fetched() -> Path:
    """Fetch the real package, once for all runs of the tests, and fill a library from it."""
    digest = hashlib.sha256()
    for source in sorted(Path(pgdm.library.__file__).parent.rglob("*.py")):
        digest.update(source.read_bytes())
    root = CACHE / f"registry-{digest.hexdigest()[:16]}"
    if (root / "registry").is_dir():
        return root
    try:
        # Into a fresh folder, then renamed: another worker may be doing the same.
        CACHE.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(dir=CACHE, prefix="fetching-"))
        fetch_registry(fresh, downloads=DOWNLOADS)
        with contextlib.suppress(OSError):
            fresh.rename(root)
    except LibraryError as error:
        if "pip finds no" in str(error) or "broke off" in str(error):
            pytest.skip(f"no package index: {error}")
        raise
    return root


@pytest.mark.slow
def test_the_package_gives_the_40_motion_capture_tasks(fetched: Path) -> None:
    library = open_library(fetched)
    assert sorted(library.tasks()) == sorted(MOCAP_TASKS)
    assert library.hands() == ["adroit", "dhand", "dmanus"]
    assert len(library.objects()) == 59
    content = library.sources()["registry"]
    assert content.left_out == {}
    assert len(content.defects) == 1  # the typing error came from here
    assert PACKAGE.sha256 in content.origin
    assert not any(name.startswith(".unpacked") for name in content.files)
    assert damaged(library) == []
    for task in library.tasks():
        motion = library.motion(task)
        assert list(motion.starts) == ["mined"]
        assert motion.starts["mined"].qpos.shape == (36,)
    assert any("no planned start" in line for line in explain(library, "hammer-use1"))


@pytest.mark.slow
def test_fetching_again_uses_the_cache_and_gives_the_same(fetched: Path, tmp_path: Path) -> None:
    fetch_registry(tmp_path, offline=True, downloads=DOWNLOADS)
    for folder in ("registry", "experts"):
        one, two = snapshot(fetched / folder), snapshot(tmp_path / folder)
        one.pop("manifest.json"), two.pop("manifest.json")  # they hold the time
        assert one == two


@pytest.fixture(scope="module")
def both(fetched: Path, library_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Library:
    """Join the two sources into one library."""
    root = tmp_path_factory.mktemp("both")
    (root / "checkout").symlink_to(library_home / "library" / "checkout")
    (root / "registry").symlink_to(fetched / "registry")
    return open_library(root)


def _equal_but_for_looks(one: Path, two: Path) -> None:
    found = compare(compiled(one, one.name), compiled(two, two.name))
    assert [str(d) for d in found if d.physical] == []


@pytest.mark.slow
@pytest.mark.skipif(not ROOT, reason="needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
class TestBothSources:
    """The fetched models equal a checkout's, each value to 1e-9."""

    @pytest.mark.parametrize("hand", ["adroit", "dhand", "dmanus"])
    def test_hands(self, both: Library, hand: str) -> None:
        _equal_but_for_looks(both.hand_xml(hand, "checkout"), both.hand_xml(hand, "registry"))

    def test_objects(self, both: Library) -> None:
        contents = both.sources()
        names = set(contents["checkout"].objects)
        assert names - set(contents["registry"].objects) == NOT_IN_PACKAGE
        for name in sorted(names - NOT_IN_PACKAGE):
            one, two = both.object_xml(name, "checkout"), both.object_xml(name, "registry")
            assert [str(d) for d in compare(compiled(one, name), compiled(two, name))] == [], name

    def test_scene(self, both: Library) -> None:
        models = [compiled(both.scene_xml(s), s) for s in ("checkout", "registry")]
        assert compare_options(*models) == []
        assert {d.element for d in compare(*models)} == {"geom skyline"}  # only shows

    def test_tasks_differ_only_as_documented(self, both: Library) -> None:
        usual = {
            "scene: geom skyline looks different (does not collide)",
            "start planned: only in checkout",
        }
        more = {}
        for task in MOCAP_TASKS:
            rest = set(differences(both, task, "checkout", "registry")) - usual
            if rest:
                more[task] = sorted(rest)
        assert more == {
            "alarmclock-see1": ["start learned: only in checkout"],
            "duck-inspect1": ["start learned: only in checkout"],
            "stanfordbunny-inspect1": ["start learned: only in checkout"],
            "wineglass-drink1": ["start mined: differs in 5 joints, by up to 1.6 (m, rad)"],
            "wineglass-toast1": ["start mined: differs in 30 joints, by up to 0.0821 (m, rad)"],
        }

    def test_the_rebuilt_pre_grasp_touches_nothing(self, both: Library) -> None:
        model = _scene(both, "wineglass", "registry")
        data = mujoco.MjData(model)
        data.qpos[:] = both.motion("wineglass-toast1", "registry").starts["mined"].qpos
        mujoco.mj_forward(model, data)
        names = [
            {model.body(model.geom_bodyid[g]).name.split("/")[0] for g in (c.geom1, c.geom2)}
            for c in data.contact
            if c.dist < 0.0005
        ]
        assert [n for n in names if n == {"adroit", "wineglass"}] == []

    def test_a_rollout_is_the_same_to_the_bit(self, both: Library) -> None:
        ends = []
        for source in ("checkout", "registry"):
            model = _scene(both, "hammer", source)
            data = mujoco.MjData(model)
            data.qpos[:] = both.motion("hammer-use1", source).starts["mined"].qpos
            stream = np.random.Generator(np.random.PCG64(0))
            low, high = model.actuator_ctrlrange.T
            for _ in range(50):
                data.ctrl[:] = low + stream.random(model.nu) * (high - low)
                mujoco.mj_step(model, data, 10)
            ends.append(data.qpos.copy())
        assert np.abs(ends[0] - ends[1]).max() == 0.0


def _scene(library: Library, thing: str, source: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(library.scene_xml(source)))
    for path in (library.hand_xml("adroit", source), library.object_xml(thing, source)):
        part = mujoco.MjSpec.from_file(str(path))
        spec.attach(part, prefix=f"{part.modelname}/", frame=spec.worldbody.add_frame())
    spec.body(f"{thing}/object").pos = (0.0, 0.0, 0.2)
    return spec.compile()
