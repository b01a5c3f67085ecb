"""Proximal policy optimisation: learns from each rollout once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pgdm.errors import ConfigError, RunError
from pgdm.rl.collector import Aside, Rollout, Step, torch_threads
from pgdm.rl.learner import AlgoCfg
from pgdm.rl.loss import PolicyLoss, Samples, advantages, policy_loss, value_loss
from pgdm.rl.networks import ActorCritic, NetworkCfg, gaussian_log_prob
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream


@dataclass(frozen=True)
class PPOCfg(AlgoCfg):
    """Settings of PPO; the paper's are in ``conf/algo/ppo.yaml``."""

    gae_lambda: float
    """Lambda of generalised advantage estimation, 0..1."""
    adam_eps: float
    """Epsilon of Adam."""
    value_coef: float
    """Weight of the value loss."""
    entropy_coef: float
    """Weight of the entropy bonus."""
    clip: float
    """Clip range of the probability ratio."""
    minibatch_size: int
    """M, samples in one gradient step; divides num_envs * steps_per_env."""
    epochs: int
    """Passes over the collected samples."""
    normalize_advantage: bool
    """Whether advantages are standardised within each minibatch."""
    max_grad_norm: float
    """Gradients are scaled down to this norm."""
    normalize_observations: bool
    """Whether observations are standardised by their running mean and variance."""

    def check(self, num_envs: int) -> None:
        """Check that the minibatches come out even; see `AlgoCfg.check`."""
        check_batch(self, num_envs)


def build_model(env: VecEnv, cfg: PPOCfg, seed: int, device: str) -> ActorCritic:
    """Return new networks for an environment."""
    network = NetworkCfg(
        obs_dim=env.obs_dim,
        action_dim=env.action_dim,
        hidden=list(cfg.hidden),
        log_std_init=cfg.log_std_init,
        normalize_observations=cfg.normalize_observations,
        observation_clip=cfg.observation_clip,
    )
    bias = env.warm_start() if cfg.warm_start else None
    return ActorCritic(network, torch_stream(seed, "weights"), bias).to(device)


class PPOLearner:
    """Holds the optimiser and takes the gradient steps.

    Policy and value function are separate networks that meet only in the norm of the gradient. On
    a CPU with threads to spare each gets one of its own. Torch's own threads would share every
    single matrix product instead: no faster on an idle machine, and many times slower on a busy one
    because each product then waits for the slowest thread. It also makes the result independent of
    the number of threads.

    Args:
        model: policy and value function, changed in place.
        cfg: settings of PPO.
        generator: stream of the order in which samples are visited.
        num_threads: threads to use; more than 2 make no difference.
    """

    def __init__(
        self, model: ActorCritic, cfg: PPOCfg, generator: torch.Generator, num_threads: int
    ) -> None:
        self.model, self.cfg, self._generator = model, cfg, generator
        self._params = list(model.parameters())
        self._optimizer = torch.optim.Adam(
            self._params, lr=cfg.learning_rate, eps=cfg.adam_eps, fused=True
        )
        self._aside = Aside("pgdm-critic", num_threads > 1 and model.device.type == "cpu")

    overlaps = False

    def during_step(self) -> None:
        """Do nothing: all is learned between two rollouts."""

    def after_step(self, step: Step) -> None:
        """Do nothing: the rollout has it."""

    def learn(self, rollout: Rollout) -> dict[str, float]:
        """Take ``epochs`` passes over a rollout; return what is logged.

        The statistics of the observations are brought up to date last: all of an iteration,
        acting and learning, sees the same ones.

        Raises:
            RunError: if a loss or gradient is not finite; that step is then not taken.
        """
        with torch_threads(1):
            samples, metrics = self._prepare(rollout)
            steps = [
                self._update(samples, rows)
                for _ in range(self.cfg.epochs)
                for rows in self._minibatches(len(samples.obs))
            ]
            if self.model.normalizer is not None:
                self.model.normalizer.update(rollout.obs[:-1].flatten(0, 1).to(self.model.device))
        means = torch.stack(steps).mean(0).tolist()
        return {**metrics, **dict(zip(_LOGGED, means, strict=True)), **self._policy_metrics()}

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimiser and the state of the visiting order's stream."""
        return {
            "model": {name: value.clone() for name, value in self.model.state_dict().items()},
            "optimizer": self._optimizer.state_dict(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self.model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])

    def _prepare(self, rollout: Rollout) -> tuple[Samples, dict[str, float]]:
        """Return all T * N samples with their advantages, and the value function's quality."""
        cfg, device = self.cfg, self.model.device
        with torch.no_grad():
            obs = self.model.normalize(rollout.obs.to(device))  # (T + 1, N, D)
            values = self.model.value(obs).cpu()  # (T + 1, N), once an iteration as in R
            next_values = values[1:].clone()
            for t, rows, last in rollout.last_obs:
                next_values[t, rows] = self.model.value(self.model.normalize(last.to(device))).cpu()
            log_prob = gaussian_log_prob(
                rollout.mean, self.model.log_std.cpu(), rollout.action
            )  # (T, N)
            advantage, target = advantages(
                values[:-1],
                next_values,
                rollout.reward,
                rollout.terminated,
                rollout.truncated,
                rollout.discount,
                gamma=cfg.gamma,
                gae_lambda=cfg.gae_lambda,
            )
        columns = (rollout.action, log_prob, advantage, target)
        samples = Samples(
            obs[:-1].flatten(0, 1), *(column.flatten(0, 1).to(device) for column in columns)
        )
        return samples, {"explained_variance": explained_variance(values[:-1], target)}

    def _minibatches(self, count: int) -> tuple[Tensor, ...]:
        order = torch.randperm(count, generator=self._generator).to(self.model.device)
        return order.split(self.cfg.minibatch_size)

    def _update(self, samples: Samples, rows: Tensor) -> Tensor:
        """Take one gradient step on some rows (M,); return the numbers of ``_LOGGED``."""
        self._optimizer.zero_grad()
        value_error = self._aside(lambda: self._value_gradient(samples, rows))
        policy = self._policy_gradient(samples, rows)
        error = value_error()
        norm = torch.nn.utils.clip_grad_norm_(self._params, self.cfg.max_grad_norm)
        logged = torch.stack((policy[1], error, *policy[2:], norm)).detach()
        if not math.isfinite(float(logged.sum())):
            _check_finite(logged)
        self._optimizer.step()
        return logged

    def _policy_gradient(self, samples: Samples, rows: Tensor) -> PolicyLoss:
        minibatch = Samples(*(column.index_select(0, rows) for column in samples))
        loss = policy_loss(
            self.model.mean(minibatch.obs),
            self.model.log_std,
            minibatch,
            clip=self.cfg.clip,
            entropy_coef=self.cfg.entropy_coef,
            normalize_advantage=self.cfg.normalize_advantage,
        )
        loss.total.backward()
        return loss

    def _value_gradient(self, samples: Samples, rows: Tensor) -> Tensor:
        obs, target = (column.index_select(0, rows) for column in (samples.obs, samples.target))
        error = value_loss(self.model.value(obs), target)
        (self.cfg.value_coef * error).backward()
        return error

    def _policy_metrics(self) -> dict[str, float]:
        std = float(self.model.log_std.detach().exp().mean())
        return {"action_std": std, "lr": float(self._optimizer.param_groups[0]["lr"])}


_LOGGED = (
    *("loss_policy", "loss_value", "entropy", "kl", "clip_fraction", "ess"),
    "grad_norm",
)
"""Means over the gradient steps of an iteration, in the order that ``_update`` returns them."""


def check_batch(cfg: PPOCfg, num_envs: int) -> None:
    """Check that the minibatches come out even.

    Raises:
        ConfigError: with the sizes, if they do not.
    """
    samples, size = num_envs * cfg.steps_per_env, cfg.minibatch_size
    if samples % size:
        divisor = next(n for n in range(min(samples, size), 0, -1) if samples % n == 0)
        raise ConfigError(
            f"algo.minibatch_size {size} does not divide the {samples} samples of an iteration "
            f"(num_envs {num_envs} * algo.steps_per_env {cfg.steps_per_env}); choose a divisor "
            f"such as {divisor}"
        )


def explained_variance(values: Tensor, target: Tensor) -> float:
    """Return 1 - var(target - values) / var(target), 1 at best; NaN if the target is constant."""
    spread = float(target.var(correction=0))
    if spread == 0:
        return math.nan
    return 1 - float((target - values).var(correction=0)) / spread


def _check_finite(logged: Tensor) -> None:
    """Raise an error that names the first bad number of a gradient step."""
    values = dict(zip(_LOGGED, logged.tolist(), strict=True))
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if bad:
        shown = ", ".join(f"{name} {value:g}" for name, value in values.items())
        raise RunError(
            f"{bad[0]} is not finite ({shown}); the step was not taken, the last checkpoint is "
            "good: try a lower algo.learning_rate"
        )
