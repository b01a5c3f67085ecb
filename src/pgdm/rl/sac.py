"""Soft actor-critic: learns from frames sampled from a replay."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from pgdm.errors import ConfigError, RunError
from pgdm.rl.learner import AlgoCfg
from pgdm.rl.networks import ActionValue, SquashedCfg, SquashedPolicy
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream

if TYPE_CHECKING:  # torchrl takes 2 s to import
    from tensordict import TensorDict

    from pgdm.rl.replay import Column


@dataclass(frozen=True)
class SACCfg(AlgoCfg):
    """Settings of soft actor-critic; ``conf/algo/sac.yaml`` has the values."""

    usual_steps_per_s: ClassVar[float] = 400.0
    usual_frame_bytes: ClassVar[int] = 1_500

    reward_scale: float
    """Factor on the rewards in the learner's targets."""
    adam_betas: list[float]
    """Adam's two decay rates, each at least 0 and below 1."""
    critics: int
    """Number of critics; the lowest of their values is used."""
    target_rate: float
    """Fraction by which the target critics move towards the critics in each update, 0..1."""
    batch_size: int
    """M, frames in one update."""
    updates_per_step: int
    """Updates of the critics per control step of all simulations."""
    actor_interval: int
    """Updates of the critics per update of policy and temperature."""
    target_entropy: float
    """Target of the policy's entropy at the start, nats per action dimension."""
    target_entropy_end: float
    """Target entropy after ``target_entropy_frames``, reached linearly."""
    target_entropy_frames: int
    """Environment steps over which the target entropy changes. They do not depend on
    ``total_frames``, so that extending a run does not alter the change."""
    temperature_init: float
    """Weight of the entropy in the return at the start."""
    noise_correlation: float
    """Correlation of the exploration noise between consecutive control steps, 0..1; 0: none."""
    average_rate: float
    """Fraction by which the averaged policy moves towards the trained one after each of its
    updates, 0..1; 0: no average, the trained policy is evaluated and stored."""
    pre_tanh_limit: float | None
    """Largest average magnitude of the entries of the policy's mean before tanh; None: no limit."""
    warmup_steps: int
    """Control steps of all simulations before the first update."""
    bfloat16: bool
    """Whether matrix products are computed in bfloat16 on devices that have it; see
    `has_bfloat16`."""

    def check(self, num_envs: int) -> None:
        """Check Adam's decay rates; see `AlgoCfg.check`."""
        if len(self.adam_betas) != 2 or not all(0 <= beta < 1 for beta in self.adam_betas):
            raise ConfigError(
                f"algo.adam_betas is {self.adam_betas}; it must be two numbers of at least 0 and "
                "below 1, such as [0.9,0.99]"
            )

    @property
    def networks(self) -> int:
        """Number of trained networks: the policy and the critics."""
        return 1 + self.critics

    def capacity(self, num_envs: int, total_frames: int) -> int:
        """Return ``total_frames`` rounded up to whole iterations."""
        per_iteration = num_envs * self.steps_per_env
        return -(-total_frames // per_iteration) * per_iteration

    def disk_bytes(self, env: VecEnv, num_envs: int, total_frames: int) -> int:
        """Return the size of the replay, bytes."""
        frame = sum(column.nbytes for column in columns(env).values())
        return frame * self.capacity(num_envs, total_frames)


class SACLearner:
    """Holds networks, target networks, temperature, optimisers and the replay.

    During each step of the simulations it makes ``updates_per_step`` updates from earlier steps.
    The updates use one thread, since further threads speed up the physics more than these matrix
    products.

    Args:
        env: environment of the policy: gives sizes, reward terms and warm start.
        cfg: settings.
        seed: the run's seed.
        total_frames: length of the training, environment steps.
        replay_folder: folder of the replay, or None to keep it in memory.
        device: device of the networks.
        num_threads: if above 1, updates and physics overlap.
    """

    def __init__(
        self,
        env: VecEnv,
        cfg: SACCfg,
        seed: int,
        total_frames: int,
        replay_folder: Path | None,
        device: str,
        num_threads: int,
    ) -> None:
        from torchrl.objectives import SoftUpdate

        from pgdm.rl.replay import Replay
        from pgdm.rl.sac_loss import SoftActorCriticLoss

        self.cfg, self._env = cfg, env
        self.overlaps = num_threads > 1
        weights = torch_stream(seed, "weights")
        network = SquashedCfg(
            kind="squashed",
            obs_dim=env.obs_dim,
            action_dim=env.action_dim,
            hidden=list(cfg.hidden),
            log_std_init=cfg.log_std_init,
            observation_clip=cfg.observation_clip,
            pre_tanh_limit=cfg.pre_tanh_limit,
        )
        bias = env.warm_start() if cfg.warm_start else None
        self._policy = self.model = SquashedPolicy(network, weights, bias).to(device)
        if cfg.average_rate:
            self.model = copy.deepcopy(self._policy)
            self.model.normalizer = self._policy.normalizer
        critics = [
            ActionValue(env.obs_dim, env.action_dim, cfg.hidden, weights).to(device)
            for _ in range(cfg.critics)
        ]
        self._actions = torch_stream(seed, "policy")
        self._loss = SoftActorCriticLoss(
            self._policy,
            critics,
            gamma=cfg.gamma,
            temperature=cfg.temperature_init,
            target_entropy=cfg.target_entropy * env.action_dim,  # at the start
            generator=self._actions,
        )
        self._targets = SoftUpdate(self._loss, tau=cfg.target_rate)
        self._critic_params = list(self._loss.qvalue_network_params.parameters())
        self._policy_params = list(self._loss.actor_network_params.parameters())
        self._optimizers = {
            "critics": self._adam(self._critic_params),
            "policy": self._adam(self._policy_params),
            "temperature": self._adam([self._loss.log_alpha]),
        }
        self._samples = torch_stream(seed, "replay")
        self._replay = Replay(
            columns(env),
            cfg.capacity(env.num_envs, total_frames),
            cfg.batch_size,
            self._samples,
            replay_folder,
            None if env.device.type == "cpu" else env.device,
        )
        self._noise: Tensor | None = None
        self._updates = 0
        self._logged: list[dict[str, Tensor]] = []

    def explore(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Draw training actions (N, A) at raw observations (N, D); return them and the means.

        The noise e before tanh is standard normal at every step; between consecutive steps of a
        simulation it has the correlation rho of ``noise_correlation``,
        e' = rho e + sqrt(1 - rho^2) n with n standard normal. Servos filter out noise that changes
        at every step (Eberhard et al. 2023 use pink noise for the same reason).
        """
        rho = self.cfg.noise_correlation
        if not rho:
            return self._policy.sample(obs)
        fresh = torch.randn(len(obs), self._env.action_dim)
        if self._noise is None:
            self._noise = fresh
        else:
            self._noise = rho * self._noise + math.sqrt(1 - rho * rho) * fresh
        return self._policy.sample(obs, noise=self._noise)

    def during_step(self) -> None:
        """Make the updates of one control step; none during the first ``warmup_steps``.

        Raises:
            RunError: if a loss is not finite; that gradient step is not taken.
        """
        if len(self._replay) < self.cfg.warmup_steps * self._env.num_envs:
            return
        for _ in range(self.cfg.updates_per_step):
            self._update()

    def after_step(self, step: Mapping[str, Any]) -> None:
        """Append a step to the replay and update the observation statistics.

        Truncated rows, simulations that diverged, stay out of the replay: their next state is
        unknown.
        """
        self.model.normalizer.update(step["observation"].to(self.model.device))
        after = step["next"]
        truncated = after["truncated"][:, 0]
        known = ~truncated if truncated.any() else slice(None)
        ones = torch.ones(len(truncated), device=truncated.device)
        columns = {
            "observation": step["observation"],
            "action": step["action"],
            "terms": torch.stack(tuple(after["raw_terms"].values()), -1),
            "discount": after["discount"][:, 0] if "discount" in after else ones,
            "terminated": after["terminated"][:, 0],
            "next_observation": after["observation"],
        }
        self._replay.append({name: column[known] for name, column in columns.items()})

    def learn(self, rollout: TensorDict) -> dict[str, float]:
        """Return means, over the iteration's updates, of the metrics to log.

        Raises:
            RunError: if a weight is no longer finite.
        """
        logged, self._logged = self._logged, []
        if not math.isfinite(sum(float(p.detach().sum()) for p in self._loss.parameters())):
            raise RunError(
                "a weight is not finite after the iteration's updates; nothing was saved, the last "
                "checkpoint is good: try a lower algo.learning_rate"
            )
        names = {name for one in logged for name in one}
        return {
            name: float(torch.stack([one[name] for one in logged if name in one]).mean())
            for name in sorted(names)
        }

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, temperature, optimisers, streams and the replay's state."""
        return {
            "model": {name: value.clone() for name, value in self.model.state_dict().items()},
            "loss": {name: value.clone() for name, value in self._loss.state_dict().items()},
            "optimizers": {name: o.state_dict() for name, o in self._optimizers.items()},
            "streams": [g.get_state() for g in (self._actions, self._samples)],
            "noise": self._noise,
            "updates": self._updates,
            "replay": self._replay.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``.

        Raises:
            CheckpointError: if the replay's files do not match the checkpoint.
        """
        self._replay.load_state_dict(state["replay"])
        self.model.load_state_dict(state["model"])
        self._loss.load_state_dict(state["loss"])
        for name, optimizer in self._optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        for stream, stored in zip((self._actions, self._samples), state["streams"], strict=True):
            stream.set_state(stored)
        self._noise = state.get("noise")  # older checkpoints have none
        self._updates = int(state["updates"])

    def _update(self) -> None:
        batch = self._batch()
        self._updates += 1
        self._loss.steer_to(self._target_entropy())
        with self._precision():
            critic_loss = self._loss.critic_loss(batch)
        logged = {"loss_critic": critic_loss.detach()}
        self._step("critics", critic_loss)
        if self._updates % self.cfg.actor_interval == 0:
            with self._precision():
                policy, temperature, entropy = self._loss.policy_and_temperature_loss(batch)
            logged |= {
                "loss_policy": policy.detach(),
                "entropy": entropy,
                "temperature": self._loss.log_alpha.detach().exp(),
            }
            self._step("policy", policy)
            self._average()
            self._step("temperature", temperature)
        self._targets.step()
        self._logged.append(logged)

    @torch.no_grad()
    def _average(self) -> None:
        if self.model is not self._policy:
            trained = self._policy.net.parameters()
            for mean, value in zip(self.model.net.parameters(), trained, strict=True):
                mean.lerp_(value, self.cfg.average_rate)

    def _target_entropy(self) -> float:
        cfg, passed = self.cfg, len(self._replay) / self.cfg.target_entropy_frames
        change = cfg.target_entropy_end - cfg.target_entropy
        return self._env.action_dim * (cfg.target_entropy + min(1.0, passed) * change)

    def _step(self, name: str, loss: Tensor) -> None:
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RunError(
                f"the loss of the {name} is {value}; the step was not taken, the last "
                "checkpoint is good: try a lower algo.learning_rate"
            )
        optimizer = self._optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def _batch(self) -> TensorDict:
        from tensordict import TensorDict

        frames = self._replay.sample().to(self.model.device)
        normalize = self.model.normalizer
        weights = torch.tensor(list(self._env.reward_weights().values()))
        reward = self.cfg.reward_scale * (frames["terms"] @ weights.to(frames.device).float())
        ended = frames["terminated"][:, None]
        after = {
            # Zeroed: a non-finite value times the 0 of a terminated step is still NaN.
            "observation": normalize(frames["next_observation"].masked_fill(ended, 0.0)),
            "reward": reward[:, None],
            "discount": frames["discount"][:, None],
            "terminated": ended,
            "done": ended,
        }
        batch = {
            "observation": normalize(frames["observation"]),
            "action": frames["action"],
            "next": TensorDict(after, batch_size=frames.batch_size),
        }
        return TensorDict(batch, batch_size=frames.batch_size)

    def _precision(self) -> torch.autocast:
        return torch.autocast(
            self.model.device.type, dtype=torch.bfloat16, enabled=self._in_bfloat16
        )

    @cached_property  # determined once, not at every update
    def _in_bfloat16(self) -> bool:
        return self.cfg.bfloat16 and has_bfloat16(self.model.device.type)

    def _adam(self, params: list[Tensor]) -> torch.optim.Adam:
        first, second = self.cfg.adam_betas
        return torch.optim.Adam(
            params, lr=self.cfg.learning_rate, betas=(first, second), fused=True
        )


def has_bfloat16(device: str) -> bool:
    """Return whether a device (``cpu``, ``cuda``) has instructions for bfloat16.

    Without them torch emulates bfloat16, and an update takes many times as long as in float32.
    """
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    found = torch.cpu.get_capabilities()
    return any(found.get(name) for name in ("amx_bf16", "avx512_bf16", "bf16"))


def columns(env: VecEnv) -> dict[str, Column]:
    """Return the replay's columns.

    Reward terms are kept before weighting, so that a weight that changes during training applies
    to past frames too.
    """
    from pgdm.rl.replay import Column

    terms = tuple(env.reward_weights())
    return {
        "observation": Column(torch.float16, (env.obs_dim,)),
        "action": Column(torch.float16, (env.action_dim,)),
        "terms": Column(torch.float32, (len(terms),), terms),
        "discount": Column(torch.float32),
        "terminated": Column(torch.bool),
        "next_observation": Column(torch.float16, (env.obs_dim,)),
    }
