"""pgdm's parts in a TorchRL loop, and TorchRL's parts with pgdm's tasks: docs/torchrl.md."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

import pgdm
from pgdm.rl.actor import GaussianActor
from pgdm.rl.collector import RolloutCollector
from pgdm.rl.loss import ProximalPolicyLoss
from toy_envs import PointEnv

DOCS = Path(__file__).resolve().parents[1] / "docs"


def networks(obs_dim: int, action_dim: int) -> tuple[GaussianActor, TensorDictModule]:
    actor = GaussianActor(nn.Linear(obs_dim, action_dim), nn.Parameter(torch.zeros(action_dim)))
    return actor, TensorDictModule(nn.Linear(obs_dim, 1), ["observation"], ["state_value"])


def test_the_script_of_the_page_trains(library_home: Path) -> None:
    page = (DOCS / "torchrl.md").read_text(encoding="utf-8")
    assert '```{.python}\n--8<-- "torchrl_ppo.py"\n```' in page
    script = [sys.executable, str(DOCS / "torchrl_ppo.py"), "8192"]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rewards = re.findall(r"^reward (\d\.\d+), episodes \d+$", done.stdout, re.MULTILINE)
    assert len(rewards) == 2 and 0 < float(rewards[0]) < 2


def test_the_script_with_torchrls_own_parts_trains(library_home: Path) -> None:
    page = (DOCS / "torchrl.md").read_text(encoding="utf-8")
    assert '```{.python}\n--8<-- "torchrl_collector.py"\n```' in page
    script = ["-W", "error::UserWarning", str(DOCS / "torchrl_collector.py"), "8192"]
    done = subprocess.run([sys.executable, *script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rewards = re.findall(r"^(?:mean action: )?reward (\d\.\d+)$", done.stdout, re.MULTILINE)
    assert len(rewards) == 3 and 0 < float(rewards[-1]) < 2


def test_the_pages_example_of_torchrls_collector_runs(
    library_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (DOCS / "torchrl.md").read_text(encoding="utf-8")
    [block] = re.findall(r"```python\n(import pgdm\n.*?)```", page, re.DOTALL)
    for number, less in (("64", "2"), ("4096", "16"), ("8192", "32")):
        assert block.count(number) == 1
        block = block.replace(number, less)
    exec(block, {})
    assert capsys.readouterr().out.count("tensor(") == 2


def test_pgdms_loss_learns_from_torchrls_collector(library_home: Path) -> None:
    from torchrl.collectors import Collector

    env = pgdm.make_torchrl("dmanus-crackerbox", num_envs=2, num_threads=1)
    actor, critic = networks(
        env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    )
    frames = {"frames_per_batch": 16, "total_frames": 16}
    collector = Collector(env, actor, **frames, auto_register_policy_transforms=False)
    [rollout] = list(collector)
    loss = ProximalPolicyLoss(actor, critic)
    loss.make_value_estimator(gamma=0.9, lmbda=0.9)
    out = loss(rollout)
    assert float(out["kl_approx"]) == pytest.approx(0, abs=1e-4)  # the policy that acted
    sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()  # noqa: SIM118
    assert all(p.grad is not None for p in loss.parameters())


def test_torchrls_loss_learns_from_pgdms_collector() -> None:
    from torchrl.objectives import ClipPPOLoss

    env = PointEnv(4)
    actor, critic = networks(env.obs_dim, env.action_dim)
    rollout = RolloutCollector(env, actor, frames_per_batch=40).rollout().reshape(-1)
    losses = [
        ClipPPOLoss(actor, critic),
        ProximalPolicyLoss(actor, critic, normalize_advantage=False),
    ]
    theirs, ours = (loss(rollout) for loss in losses)
    for key in ("loss_objective", "loss_entropy", "clip_fraction", "ESS"):
        torch.testing.assert_close(theirs[key], ours[key], rtol=1e-4, atol=1e-6)


def test_torchrl_is_not_imported_before_a_training_starts() -> None:
    code = (
        "import sys, pgdm, pgdm.rl.trainer, pgdm.experiment;"
        "print({'torchrl', 'tensordict'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
