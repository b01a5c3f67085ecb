"""Small environments that a policy learns in seconds, and matching settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
import yaml
from torch import Tensor

from pgdm.rl.learner import AlgoCfg
from pgdm.rl.ppo import PPOCfg
from pgdm.rl.sac import SACCfg
from pgdm.rl.trainer import TrainerCfg
from pgdm.seeding import torch_stream

ALGO = Path(__file__).resolve().parents[1] / "conf" / "algo"
PAPER = PPOCfg(**yaml.safe_load((ALGO / "ppo.yaml").read_text(encoding="utf-8")))
TOY = replace(
    PAPER, learning_rate=1e-3, steps_per_env=32, minibatch_size=64, hidden=[32, 32], log_std_init=-1
)
TOY_SAC = replace(
    SACCfg(**yaml.safe_load((ALGO / "sac.yaml").read_text(encoding="utf-8"))["algo"]),
    learning_rate=3e-3,
    steps_per_env=32,
    hidden=[32, 32],
    log_std_init=-1.0,
    reward_scale=1.0,
    target_rate=0.02,
    batch_size=64,
    updates_per_step=1,
    target_entropy_end=-1.0,
    target_entropy_frames=1000,
    temperature_init=0.05,
    bfloat16=False,
)


def trainer_cfg(algo: AlgoCfg = TOY, **changes: Any) -> TrainerCfg:
    cfg = TrainerCfg(
        algo=algo,
        seed=3,
        total_frames=4096,
        time_limit_s=None,
        eval_interval_frames=0,
        checkpoint_interval_s=1e9,
        device="cpu",
        num_threads=1,
    )
    return replace(cfg, **changes)


@dataclass(frozen=True)
class Ended:
    """Episodes that finished."""

    values: dict[str, Tensor]

    def metrics(self) -> dict[str, Tensor]:
        return self.values

    def with_later(self, later: Sequence[Self]) -> Ended:
        every = (self.values, *(ended.values for ended in later))
        return Ended({name: torch.cat([v[name] for v in every]) for name in self.values})


class PointEnv:
    """A point in the plane that should be pushed to the origin from a random start.

    Terminates after 20 steps; truncated when it leaves the square of half-width 2.
    """

    obs_dim, action_dim = 5, 2

    def __init__(self, num_envs: int = 8, seed: int = 0, scale: float = 1.0) -> None:
        self.num_envs, self.device, self._scale = num_envs, torch.device("cpu"), scale
        self._generator = torch_stream(seed, "point")
        self._t = torch.zeros(num_envs, dtype=torch.int64)
        self._return = torch.zeros(num_envs)
        self._pos = torch.zeros(num_envs, 2)
        self.weights = {"near": 1.0}

    def reset(self) -> Tensor:
        self._restart(torch.ones(self.num_envs, dtype=torch.bool))
        return self._obs()

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self._pos = self._pos + 0.2 * action.clamp(-1, 1)
        self._t = self._t + 1
        near = -self._pos.norm(dim=1)
        reward = self.weights["near"] * near
        self._return = self._return + reward
        terminated = self._t >= 20
        truncated = (self._pos.abs() > 2).any(1) & ~terminated
        done = terminated | truncated
        info: dict[str, Any] = {
            "final_obs": self._obs(),
            "terms": {"near": reward},
            "raw_terms": {"near": near},
            "episodes": None,
        }
        if done.any():
            close = (self._pos[done].norm(dim=1) < 0.2).float()
            info["episodes"] = Ended(
                {"return": self._return[done], "success": close, "length": self._t[done]}
            )
            self._restart(done)
        return self._obs(), reward, terminated, truncated, info

    def _restart(self, rows: Tensor) -> None:
        fresh = 2 * torch.rand(self.num_envs, 2, generator=self._generator) - 1
        self._pos = torch.where(rows[:, None], fresh, self._pos)
        self._t = self._t.masked_fill(rows, 0)
        self._return = self._return.masked_fill(rows, 0.0)

    def _obs(self) -> Tensor:
        time = self._t[:, None].float() / 20
        return torch.cat((self._scale * self._pos, self._pos.abs(), time), 1)

    def state_dict(self) -> dict[str, Any]:
        return {
            "t": self._t.clone(),
            "pos": self._pos.clone(),
            "return": self._return.clone(),
            "generator": self._generator.get_state(),
            "weights": dict(self.weights),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._t, self._pos = state["t"].clone(), state["pos"].clone()
        self._return, self.weights = state["return"].clone(), dict(state["weights"])
        self._generator.set_state(state["generator"])

    def warm_start(self) -> Tensor | None:
        return torch.tensor([0.25, -0.5])

    def reward_weights(self) -> dict[str, float]:
        return self.weights

    def set_weights(self, weights: dict[str, float]) -> None:
        self.weights.update(weights)


class ScriptedEnv:
    """Replays given rewards, terminations and truncations; the observation is the step count.

    Args:
        reward: (T, N).
        terminated: (T, N) bool.
        truncated: (T, N) bool.
        obs_dim: D, all entries equal.
        action_dim: A.
    """

    def __init__(
        self,
        reward: Tensor,
        terminated: Tensor | None = None,
        truncated: Tensor | None = None,
        obs_dim: int = 1,
        action_dim: int = 1,
    ) -> None:
        self.num_envs, self.obs_dim, self.action_dim = reward.shape[1], obs_dim, action_dim
        self.device = reward.device
        never = torch.zeros(reward.shape, dtype=torch.bool)
        self._reward = reward
        self._terminated = never if terminated is None else terminated
        self._truncated = never if truncated is None else truncated
        self.t = 0

    def reset(self) -> Tensor:
        self.t = 0
        return self._obs()

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        t, self.t = self.t, self.t + 1
        final = self._obs()
        done = self._terminated[t] | self._truncated[t]
        obs = torch.where(done[:, None], -final, final)  # negative after a reset
        terms = {"script": self._reward[t]}
        info = {"final_obs": final, "terms": terms, "raw_terms": terms, "episodes": None}
        return obs, self._reward[t], self._terminated[t], self._truncated[t], info

    def _obs(self) -> Tensor:
        return torch.full((self.num_envs, self.obs_dim), float(self.t))

    def state_dict(self) -> dict[str, Any]:
        return {"t": self.t}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.t = state["t"]

    def warm_start(self) -> Tensor | None:
        return None

    def reward_weights(self) -> dict[str, float]:
        return {"script": 1.0}

    def set_weights(self, weights: dict[str, float]) -> None:
        pass


class FreeEnv(ScriptedEnv):
    """An environment that steps in no time, for measuring the cost of learning itself."""

    def __init__(self, num_envs: int = 32, obs_dim: int = 322, action_dim: int = 30) -> None:
        super().__init__(torch.zeros(1, num_envs), obs_dim=obs_dim, action_dim=action_dim)
        generator = torch_stream(0, "free")
        self._frames = torch.randn(16, num_envs, obs_dim, generator=generator)
        self._rewards = torch.randn(16, num_envs, generator=generator)
        self._no = torch.zeros(num_envs, dtype=torch.bool)

    def _obs(self) -> Tensor:
        return self._frames[self.t % 16]

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self.t += 1
        obs = self._obs()
        reward = self._rewards[self.t % 16]
        terms = {"script": reward}
        info = {"final_obs": obs, "terms": terms, "raw_terms": terms, "episodes": None}
        return obs, reward, self._no, self._no, info
