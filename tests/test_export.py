"""Policies in other formats: the same actions, and the same episode without pgdm."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from command_line import TINY, TINY_SAC, command
from pgdm.envs.build import EnvBuilder
from pgdm.export import tensors
from pgdm.export.description import description
from pgdm.export.measure import measure
from pgdm.export.trained import TrainedPolicy, of_run
from pgdm.library.progress import silent

SCRIPT = Path(__file__).resolve().parents[1] / "docs" / "run_policy.py"
LEARNERS = {
    "ppo": TINY,
    "ppo_fast": (*TINY, "algo=ppo_fast", "action=residual", "action.residual_power=2"),
    "sac": ("+experiment=fast", *TINY_SAC),  # its wrist is planned
}


pytestmark = pytest.mark.usefixtures("library_home")


DOCS = SCRIPT.parent


def test_the_page_has_the_program() -> None:
    page = (DOCS / "export.md").read_text(encoding="utf-8")
    assert '```{.python}\n--8<-- "run_policy.py"\n```' in page


@pytest.mark.slow
def test_commands_of_the_page(
    exported: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (DOCS / "export.md").read_text(encoding="utf-8")
    (tmp_path / "runs").mkdir()
    shutil.copytree(exported.run, tmp_path / "runs" / "hammer")
    lines = re.findall(r"^pgdm export runs/hammer .*$", page, re.MULTILINE)
    assert len(lines) == 2
    for line in lines:
        done = command(*line.replace("100", "1").split(), "--offline")
        assert done.code == 0, done.err
    line = ["dmanus-crackerbox.onnx", "scene"]
    done = subprocess.run([sys.executable, str(SCRIPT), *line], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


class Exported:
    """A policy of a short training, its task, and an episode of its mean action."""

    def __init__(self, learner: str, run: Path) -> None:
        arguments = ("task=dmanus-crackerbox", *LEARNERS[learner], f"run_dir={run}")
        done = command("pgdm-run", *arguments, "--offline")
        assert done.code == 0, done.err
        self.run = run
        self.policy: TrainedPolicy = of_run(run)
        self.builder: EnvBuilder = self.policy.builder(lambda text: None)
        env = self.builder.make(1, 1, 0, "eval", auto_reset=False)
        seen, actions, ctrl, over = [env.reset()], [], [], False
        actuators = self.builder.scene.index.actuators
        while not over:
            actions.append(self.policy.network.act(seen[-1], deterministic=True))
            targets = np.zeros(env.action_dim)
            targets[actuators] = self.builder.mdp.actions.act(actions[-1], env.t)[0]
            ctrl.append(targets)
            obs, _, terminated, truncated, _ = env.step(actions[-1])
            seen.append(obs)
            over = bool(terminated | truncated)
        self.obs = torch.cat(seen[:-1]).numpy()
        self.actions, self.ctrl = torch.cat(actions).numpy(), np.array(ctrl)


@pytest.fixture(scope="module", params=LEARNERS)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return Exported(request.param, tmp_path_factory.mktemp(request.param) / "run")


def write(exported: Exported, form: str, path: Path, *more: str) -> None:
    arguments = ("export", str(exported.run), "--format", form, "--out", str(path), *more)
    done = command("pgdm", *arguments, "--offline")
    assert done.code == 0, done.err


def test_onnx_gives_the_same_actions_and_the_same_episode(
    exported: Exported, tmp_path: Path
) -> None:
    import onnxruntime

    path, scene = tmp_path / "policy.onnx", tmp_path / "scene"
    write(exported, "onnx", path, "--scene", str(scene))
    session = onnxruntime.InferenceSession(str(path))
    steps = np.arange(len(exported.obs))
    found = session.run(["action", "ctrl"], {"observation": exported.obs, "step": steps})
    assert np.abs(found[0] - exported.actions).max() < 1e-5
    assert np.abs(found[1] - exported.ctrl).max() < 1e-5
    about = json.loads(session.get_modelmeta().custom_metadata_map["pgdm"])
    assert about == json.loads(json.dumps(description(exported.policy, exported.builder)))
    line = [sys.executable, str(SCRIPT), str(path), str(scene)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    metrics = measure(exported.policy, exported.builder, silent, episodes=1, deterministic=True)
    assert metrics is not None
    assert done.stdout == f"success {metrics['eval_deterministic/success']:.6f}\n"
    assert_same_scene(exported, scene)


def assert_same_scene(exported: Exported, folder: Path) -> None:
    model = exported.builder.scene.model
    assert sorted(p.name for p in folder.iterdir()) == ["assets", "scene.mjb", "scene.xml"]
    exact = mujoco.MjModel.from_binary_path(str(folder / "scene.mjb"))
    written = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    for field in ("body_mass", "body_pos", "geom_size", "geom_pos", "mesh_vert", "jnt_range"):
        assert np.array_equal(getattr(exact, field), getattr(model, field))
        assert np.allclose(getattr(written, field), getattr(model, field), rtol=0, atol=1e-6)


def test_torchscript_gives_the_same_actions(exported: Exported, tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    write(exported, "torchscript", path)
    extra = {"pgdm": ""}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch recommends another format
        module = torch.jit.load(str(path), _extra_files=extra)
        action, ctrl = module(torch.from_numpy(exported.obs), torch.arange(len(exported.obs)))
    assert np.abs(action.detach().numpy() - exported.actions).max() < 1e-6
    assert np.abs(ctrl.detach().numpy() - exported.ctrl).max() < 1e-6
    about: dict[str, Any] = json.loads(extra["pgdm"])
    assert about["task"] == "dmanus-crackerbox" and about["frames"] == 32


def test_safetensors_is_the_same_policy(exported: Exported, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    write(exported, "safetensors", path)
    back = tensors.read(path)
    assert back.sha256() == exported.policy.sha256()
    assert back.facts == exported.policy.facts and back.frames == 32
    acted = back.network.act(torch.from_numpy(exported.obs), deterministic=True)
    builder = back.builder(lambda text: None)
    env = builder.make(1, 1, 0, "eval")
    assert np.array_equal(env.reset().numpy(), exported.obs[:1])
    # Row by row, as in an episode: matrix products round differently in a batch.
    assert np.abs(acted.numpy() - exported.actions).max() < 1e-6


def check_relative_parts(part: Callable[[str], np.ndarray], parts: dict[str, Any]) -> None:
    """Compare the relative parts with the absolute positions in the same observation."""
    positions = part("positions").reshape(-1, 3)
    names = parts["positions"]["of"]
    assert parts["position_in_hand"]["of"] == [names[-1], names[0]]
    next_offset = part("targets_ahead")[4:7] - positions[-1]  # of the target at step t+1
    assert np.allclose(part("offsets_to_targets")[3:6], next_offset, atol=1e-6)
    # Rotations change no distances.
    in_hand, tips = part("position_in_hand"), part("fingertips_from_object").reshape(-1, 3)
    distance = np.linalg.norm(positions[-1] - positions[0])
    assert np.isclose(np.linalg.norm(in_hand), distance, atol=1e-6)
    apart = [
        positions[names.index(n)] - positions[-1] for n in parts["fingertips_from_object"]["of"]
    ]
    assert len(tips) == 3 and np.allclose(
        np.linalg.norm(tips, axis=1), np.linalg.norm(apart, axis=1), atol=1e-6
    )


def test_the_description_names_every_number(exported: Exported) -> None:
    about = description(exported.policy, exported.builder)
    parts = {part["name"]: part for part in about["observation"]}
    assert sum(part["size"] for part in parts.values()) == exported.obs.shape[1]
    seen = exported.obs[0]

    def part(name: str) -> np.ndarray:
        first = parts[name]["first"]
        return seen[first : first + parts[name]["size"]]

    start = exported.builder.mdp.start
    assert np.allclose(part("joint_positions"), start.qpos) and len(start.qpos) == 22
    assert np.allclose(part("joint_velocities"), start.qvel)
    assert parts["positions"]["of"][-1] == "crackerbox/object"
    target = exported.builder.mdp.reference.pos[1]
    assert np.allclose(part("targets_ahead")[4:7], target)  # k = 1: quaternion, then position
    assert np.allclose(part("time"), [0, 0, 0, 0, 1, 1, 1, 1])
    if exported.policy.cfg.algo.learner == "sac":  # `+experiment=fast`, with obs=relative
        check_relative_parts(part, parts)
    assert np.array_equal(np.float32(about["observation_by_step"][0]), seen[-29:])
    nu = exported.builder.scene.model.nu  # D'Manus: all
    assert about["control"] == {"timestep_s": 0.004, "substeps": 10, "compensated_joints": nu}
    action = about["action"]
    a = exported.actions[3].astype(float)
    by_hand = np.array(action["middle"]) + np.array(action["half"]) * np.clip(a, -1, 1)
    if (wrist := action["wrist"]) is not None:
        ahead = wrist["path"][min(3 + wrist["lead_steps"], len(wrist["path"]) - 1)]
        share = np.sign(a[:6]) * np.abs(np.clip(a[:6], -1, 1)) ** wrist["power"]
        base = np.array(ahead) + np.array(wrist["largest"]) * share
        by_hand[:6] = np.clip(base, wrist["low"], wrist["high"])
    names = dict(zip(action["joints"], by_hand, strict=True))
    model = exported.builder.scene.model
    for value, name in zip(exported.ctrl[3], about["actuators"], strict=True):
        joint = model.joint(model.actuator(name).trnid[0]).name
        assert value == pytest.approx(names[joint], abs=1e-12)


def test_a_minari_dataset_is_read_by_minari(
    exported: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import minari

    write(exported, "minari", tmp_path / "data", "--episodes", "2", "--deterministic")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "data"))
    algo = exported.policy.cfg.algo.name
    (name,) = minari.list_local_datasets()
    assert name == f"pgdm/dmanus-crackerbox/{algo}-s0-v0"
    data = minari.load_dataset(name)
    episodes = list(data.iterate_episodes())
    assert len(episodes) == 2
    for episode in episodes:
        assert np.array_equal(episode.observations[:-1], exported.obs)
        assert np.array_equal(episode.actions, exported.actions.clip(-1, 1))
        assert episode.terminations[-1] and not episode.terminations[:-1].any()
        assert episode.infos["object_error_m"].shape == (len(exported.obs) + 1,)
    again = ("export", str(exported.run), "--format", "minari", "--out", str(tmp_path / "data"))
    done = command("pgdm", *again, "--episodes", "1", "--offline")
    assert done.code == 2 and "exists; remove it" in done.err
