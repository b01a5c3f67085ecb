"""Policies from other people's files: bad ones end in one line, nothing is executed."""

from __future__ import annotations

import base64
import io
import json
import lzma
import os
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save

from command_line import command
from pgdm.config.compose import compose
from pgdm.errors import PgdmError
from pgdm.export import sb3, tensors
from pgdm.export.description import card
from pgdm.export.trained import TrainedPolicy
from pgdm.rl.networks import ActorCritic, NetworkCfg

SIZES = NetworkCfg(5, 3, [4], -1.6, True, 10.0)


def tiny(task: str = "cup-pour1") -> TrainedPolicy:
    network = ActorCritic(SIZES, torch.Generator().manual_seed(0)).eval()
    return TrainedPolicy("here", compose([f"task={task}"]), network, 7, {}, Path("x.mp4"))


def packed(**changes: Any) -> bytes:
    policy = tiny()
    return tensors.pack(policy, None, card(policy) | changes)


def altered(change: Callable[[dict[str, torch.Tensor]], None]) -> bytes:
    """Return a packed policy with other tensors, and their hash."""
    policy = tiny()
    found = dict(policy.network.state_dict())
    change(found)
    policy.network.load_state_dict(found)
    return tensors.pack(policy, None, card(policy))


def with_nan(state: dict[str, torch.Tensor]) -> None:
    state["policy.0.weight"] = torch.full((4, 5), torch.nan)


def with_negative_variance(state: dict[str, torch.Tensor]) -> None:
    state["normalizer.var"] = -torch.ones(5, dtype=torch.float64)


def other_weights() -> bytes:
    content = load(packed())
    content["network.policy.0.weight"] += 1
    return save(content, {"pgdm": json.dumps(card(tiny()))})


def settings(**changes: Any) -> dict[str, Any]:
    return tiny().settings() | changes


METHOD = {**tiny().settings()["method"], "name": "evil_module:recipe"}
GOOD = packed()
BAD = {
    "empty": (b"", "is not a safetensors file"),
    "text": (b"a policy, honestly", "is not a safetensors file"),
    "cut off": (GOOD[:-10], "is damaged"),
    "cut off in the header": (GOOD[:200], "is not a safetensors file, or is cut off"),
    "other people's": (save({"w": torch.zeros(1)}), "holds no policy of pgdm"),
    "no JSON": (save({"w": torch.zeros(1)}, {"pgdm": "{"}), "holds no policy of pgdm"),
    "a newer format": (packed(format="pgdm-policy-9"), "has format 'pgdm-policy-9'"),
    "a number as network": (packed(network=3), "'network' is 3"),
    "huge sizes": (packed(network={**vars(SIZES), "obs_dim": 10**12}), "no policy that this"),
    "NaN": (altered(with_nan), "has values that are not finite"),
    "a negative variance": (altered(with_negative_variance), "has negative values"),
    "other weights": (other_weights(), "do not match their SHA-256"),
    "another task": (packed(task="duck-lift"), "is of task 'duck-lift', but its settings are"),
    "a method that would be imported": (packed(settings=settings(method=METHOD)), "evil_module"),
    "settings of no run": (packed(settings={"format": 1}), "here"),
    "text as result": (packed(evaluation={"success": "1"}), "'evaluation' is"),
    "a bomb": (lzma.compress(bytes(tensors.MOST_BYTES + 1)), "would unpack to more than"),
    "cut off xz": (tensors.compressed(GOOD)[:-40], "is cut off"),
    "damaged xz": (tensors.compressed(GOOD)[:40] + b"!" * 40, "is damaged"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_safetensors(kind: str, tmp_path: Path) -> None:
    content, said = BAD[kind]
    path = tmp_path / "here.safetensors"
    path.write_bytes(content)
    with pytest.raises(PgdmError) as caught:
        tensors.read(path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_good_file_is_read_in_full_and_half_precision(tmp_path: Path) -> None:
    policy = tiny()
    for half, name in ((False, "a.safetensors"), (True, "b.safetensors.xz")):
        stored = tensors.halved(policy) if half else policy
        tensors.write(tmp_path / name, tensors.pack(stored, None, card(stored), half))
        back = tensors.read(tmp_path / name)
        assert back.sha256() == stored.sha256() and back.settings() == policy.settings()
    half = tensors.halved(policy).network.state_dict()["policy.0.weight"]
    exact = policy.network.state_dict()["policy.0.weight"]
    # float16 has 11 significant bits.
    assert 0 < (half - exact).abs().max() <= 2**-11 * exact.abs().max()


@given(place=st.integers(0, len(GOOD) - 1), byte=st.integers(0, 255))
def test_any_changed_byte_is_refused_or_harmless(place: int, byte: int) -> None:
    content = GOOD[:place] + bytes([byte]) + GOOD[place + 1 :]
    try:
        found = tensors.parse(content, "here", Path("x.mp4"))
    except PgdmError as error:
        assert "\n" not in str(error)
    else:
        assert found.sha256() == tiny().sha256()


class Runs:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def weights(**changes: Any) -> dict[str, Any]:
    """Return a policy as Stable-Baselines3 names its parts."""
    shapes = {
        "log_std": (3,),
        "mlp_extractor.policy_net.0.weight": (6, 5),
        "mlp_extractor.policy_net.0.bias": (6,),
        "mlp_extractor.policy_net.2.weight": (4, 6),
        "mlp_extractor.policy_net.2.bias": (4,),
        "mlp_extractor.value_net.0.weight": (8, 5),
        "action_net.weight": (3, 4),
        "action_net.bias": (3,),
    }
    found = {name: torch.ones(shape) for name, shape in shapes.items()}
    return {n: v for n, v in (found | changes).items() if v is not None}


def zipped(path: Path, state: Any = None, raw: bytes | None = None, **data: Any) -> Path:
    buffer = io.BytesIO()
    torch.save(weights() if state is None else state, buffer)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", json.dumps({"num_timesteps": 9, "use_sde": False, **data}))
        archive.writestr("policy.pth", buffer.getvalue() if raw is None else raw)
    return path


def bomb(path: Path) -> bytes:
    del path
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(sb3.MOST_BYTES + 1))
    return inner.getvalue()


RELU = {"activation_fn": "<class 'torch.nn.modules.activation.ReLU'>"}
BAD_ZIPS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "text": (lambda p: p.write_text("PK, honestly"), "is not a zip of Stable-Baselines3"),
    "cut off": (lambda p: p.write_bytes(zipped(p).read_bytes()[:-30]), "is not a zip of"),
    "no policy": (lambda p: zipfile.ZipFile(p, "w").close(), "is not a zip of"),
    "a bomb": (lambda p: zipped(p, raw=bytes(sb3.MOST_BYTES + 1)), "would unpack to"),
    "a bomb inside": (lambda p: zipped(p, raw=bomb(p)), "would unpack to"),
    "a pickle": (lambda p: zipped(p, state={"log_std": Runs(p / "x")}), "not a tensor or plain"),
    "a list": (lambda p: zipped(p, state=[1]), "is not a mapping of tensors"),
    "ReLU": (lambda p: zipped(p, policy_kwargs=RELU), "ReLU"),
    "gSDE": (lambda p: zipped(p, use_sde=True), "explores with gSDE"),
    "NaN": (lambda p: zipped(p, weights(log_std=torch.full((3,), torch.nan))), "not finite"),
    "a missing layer": (
        lambda p: zipped(p, weights(**{"action_net.bias": None})),
        "holds no policy of the released form",
    ),
    "no hidden layer": (lambda p: zipped(p, {"log_std": torch.ones(3)}), "holds no policy of"),
}


@pytest.mark.parametrize("kind", BAD_ZIPS)
def test_bad_zips(kind: str, tmp_path: Path) -> None:
    make, said = BAD_ZIPS[kind]
    path = tmp_path / "model.zip"
    make(path)
    with pytest.raises(PgdmError) as caught:
        sb3.read(path, "cup-pour1")
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.zip"]


def test_pickles_in_a_zips_data_are_never_decoded(tmp_path: Path) -> None:
    evil = base64.b64encode(pickle.dumps(Runs(tmp_path / "ran"))).decode()
    pickled = {":type:": "x", ":serialized:": evil}
    path = zipped(tmp_path / "model.zip", policy_class=pickled, policy_kwargs=pickled)
    policy = sb3.read(path, "cup-pour1")
    assert (policy.frames, policy.network.cfg.obs_dim, policy.network.cfg.hidden) == (9, 5, [6, 4])
    assert not (tmp_path / "ran").exists()
    # All weights 1: tanh(4 tanh(6 * ...)), summed over 4 units, plus the bias of 1.
    first = np.tanh(5 * 0.1 + 1)
    second = np.tanh(6 * first + 1)
    acted = policy.network.act(torch.full((1, 5), 0.1), deterministic=True)
    assert acted.numpy() == pytest.approx(np.full((1, 3), 4 * second + 1), rel=1e-6)


BAD_STATISTICS = {
    "text": (b"statistics", "unreadable pickle"),
    "another pickle": (pickle.dumps({"a": 1}), "holds no statistics of VecNormalize"),
    "a module's function": (pickle.dumps(os.getcwd), "asks for posix.getcwd"),
    "an opened file": (b"cio\nopen\n(Vx\nVw\ntR.", "asks for io.open"),
    "a call in a permitted package": (
        b"cnumpy.f2py.diagnose\nrun_command\n(Vtouch ran\ntR.",
        "holds no statistics",
    ),
}


@pytest.mark.parametrize("kind", BAD_STATISTICS)
def test_bad_statistics(kind: str, tmp_path: Path) -> None:
    content, said = BAD_STATISTICS[kind]
    path = tmp_path / "vecnormalize.pkl"
    path.write_bytes(content)
    zipped(tmp_path / "model.zip")
    with pytest.raises(PgdmError) as caught:
        sb3.read(tmp_path / "model.zip", "cup-pour1", vecnormalize=path)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.zip", "vecnormalize.pkl"]


def test_commands_say_what_fits(tmp_path: Path) -> None:
    path = str(zipped(tmp_path / "model.zip"))
    outcome = command("pgdm", "eval", path)
    assert outcome.code == 2 and "does not name its task; add --task TASK" in outcome.err
    outcome = command("pgdm", "eval", path, "--task", "cup-pour2")
    assert outcome.code == 2 and "unknown task 'cup-pour2'; did you mean" in outcome.err
    outcome = command("pgdm", "eval", path, "--task", "cup-pour1", "--best")
    assert outcome.code == 2 and "--best is for the folder of a run" in outcome.err
    outcome = command("pgdm", "eval", "nothing.safetensors")
    assert outcome.code == 2 and "there is no file or folder 'nothing.safetensors'" in outcome.err
    outcome = command("pgdm", "export", path, "--task", "cup-pour1", "--format", "onxx")
    assert outcome.code == 2 and "did you mean onnx?" in outcome.err
    policy = replace(tiny(), name="a")
    tensors.write(tmp_path / "a.safetensors", tensors.pack(policy, None, card(policy)))
    outcome = command("pgdm", "eval", str(tmp_path / "a.safetensors"), "--task", "cup-pour1")
    assert outcome.code == 2 and "are for .zip files of Stable-Baselines3" in outcome.err
