"""Proximal policy optimisation: learns from each rollout, then discards it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pgdm.errors import ConfigError, RunError
from pgdm.rl.learner import AlgoCfg
from pgdm.rl.networks import ActorCritic, Gaussian, NetworkCfg
from pgdm.rl.torch_state import Aside, torch_threads
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream

if TYPE_CHECKING:  # torchrl takes 2 s to import
    from tensordict import TensorDict


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
    """Largest gradient norm; gradients above it are scaled down."""
    normalize_observations: bool
    """Whether observations are standardised by their running mean and variance."""

    def check(self, num_envs: int) -> None:
        """Check that the minibatch size divides an iteration's samples; see `AlgoCfg.check`."""
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

    Policy and value function are separate networks, coupled only by the norm to which their joint
    gradient is clipped. On a CPU with two or more threads each learns in its own thread. Splitting
    each matrix product over torch's threads would make the result depend on the number of threads.
    On an idle machine it would be no faster. On a busy one it would be much slower, since each
    product would wait for the slowest thread.

    Args:
        model: policy and value function, changed in place.
        cfg: settings of PPO.
        generator: random stream of the samples' order in each pass.
        num_threads: threads to use; more than 2 make no difference.
    """

    def __init__(
        self, model: ActorCritic, cfg: PPOCfg, generator: torch.Generator, num_threads: int
    ) -> None:
        from tensordict.nn import TensorDictModule

        from pgdm.rl.actor import GaussianActor
        from pgdm.rl.loss import ProximalPolicyLoss

        self.model, self.cfg, self._generator = model, cfg, generator
        self._loss = ProximalPolicyLoss(
            GaussianActor(model.policy, model.log_std),
            TensorDictModule(model.critic, ["observation"], ["state_value"]),
            clip_epsilon=cfg.clip,
            entropy_coeff=cfg.entropy_coef,
            normalize_advantage=cfg.normalize_advantage,
        )
        self._params = list(model.parameters())
        self._optimizer = torch.optim.Adam(
            self._params, lr=cfg.learning_rate, eps=cfg.adam_eps, fused=True
        )
        self._aside = Aside("pgdm-critic", num_threads > 1 and model.device.type == "cpu")

    overlaps = False

    def explore(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Draw training actions (N, A) at raw observations (N, D); return them and the means."""
        return self.model.sample(obs)

    def during_step(self) -> None:
        """Do nothing: PPO learns between rollouts."""

    def after_step(self, step: Mapping[str, Any]) -> None:
        """Do nothing: the rollout holds the step."""

    def learn(self, rollout: TensorDict) -> dict[str, float]:
        """Make ``epochs`` passes over a rollout; return metrics to log.

        The observation statistics are updated last, so that acting and learning of an iteration
        use the same ones.

        Raises:
            RunError: if a loss, the gradient's norm or another logged value is not finite; that
                gradient step is not taken.
        """
        with torch_threads(1):
            samples, metrics = self._prepare(rollout)
            steps = [
                self._update(samples, rows)
                for _ in range(self.cfg.epochs)
                for rows in self._minibatches(len(samples))
            ]
            if self.model.normalizer is not None:
                seen = rollout.get("observation").transpose(0, 1).flatten(0, 1)
                self.model.normalizer.update(seen.to(self.model.device))
        means = torch.stack(steps).mean(0).tolist()
        std = float(self.model.log_std.detach().exp().mean())
        lr = float(self._optimizer.param_groups[0]["lr"])
        return {**metrics, **dict(zip(_LOGGED, means, strict=True)), "action_std": std, "lr": lr}

    def state_dict(self) -> dict[str, Any]:
        """Return the states of networks, optimiser and random stream."""
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

    def _prepare(self, rollout: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Return all T * N samples with their advantages, and metrics of the value function."""
        from tensordict import TensorDict

        from pgdm.rl.loss import advantages

        cfg, model = self.cfg, self.model
        steps = rollout.transpose(0, 1)  # [T, N], the layout in memory
        after: Any = steps["next"]
        with torch.no_grad():
            seen = torch.cat((steps["observation"], after["observation"][-1:]))
            obs = model.normalize(seen.to(model.device))  # (T + 1, N, D)
            # Evaluated once per iteration, as in the released code.
            values = model.value(obs).to(seen.device)  # (T + 1, N)
            next_values = values[1:].clone()
            truncated = after["truncated"][..., 0]
            for t in truncated.any(1).nonzero()[:, 0]:
                last = after["observation"][t, truncated[t]]
                normalized = model.normalize(last.to(model.device))
                next_values[t, truncated[t]] = model.value(normalized).to(seen.device)
            advantage, target = advantages(
                values[:-1].t()[..., None],
                next_values.t()[..., None],
                rollout["next"],
                gamma=cfg.gamma,
                gae_lambda=cfg.gae_lambda,
            )
            acted = Gaussian(steps["loc"], model.log_std.to(seen.device))
            columns = {
                "observation": obs[:-1],
                "action": steps["action"],
                "action_log_prob": acted.log_prob(steps["action"]),
                "advantage": advantage.transpose(0, 1),
                "value_target": target.transpose(0, 1),
            }
        samples = {name: c.flatten(0, 1).to(model.device) for name, c in columns.items()}
        quality = explained_variance(values[:-1], target[..., 0].t())
        return TensorDict(samples, [steps.numel()]), {"explained_variance": quality}

    def _minibatches(self, count: int) -> tuple[Tensor, ...]:
        order = torch.randperm(count, generator=self._generator).to(self.model.device)
        return order.split(self.cfg.minibatch_size)

    def _update(self, samples: TensorDict, rows: Tensor) -> Tensor:
        """Take one gradient step on some rows (M,); return the values of ``_LOGGED``."""
        self._optimizer.zero_grad()
        value_error = self._aside(lambda: self._value_gradient(samples, rows))
        out = self._policy_gradient(samples, rows)
        out["loss_critic"] = value_error()
        out["norm"] = torch.nn.utils.clip_grad_norm_(self._params, self.cfg.max_grad_norm)
        logged = torch.stack([out[key] for key in _LOGGED.values()]).detach()
        if not math.isfinite(float(logged.sum())):
            _check_finite(logged)
        self._optimizer.step()
        return logged

    def _policy_gradient(self, samples: TensorDict, rows: Tensor) -> dict[str, Tensor]:
        out = self._loss.loss_policy(_minibatch(samples, rows, _POLICY_KEYS))
        (out["loss_objective"] + out["loss_entropy"]).backward()
        return out

    def _value_gradient(self, samples: TensorDict, rows: Tensor) -> Tensor:
        from tensordict import TensorDict

        minibatch = TensorDict(_minibatch(samples, rows, _VALUE_KEYS), [len(rows)])
        error, *_ = self._loss.loss_critic(minibatch)
        (self.cfg.value_coef * error).backward()  # weighted here: the returned error is logged
        return error


_POLICY_KEYS = ("observation", "action", "action_log_prob", "advantage")
_VALUE_KEYS = ("observation", "value_target")
_LOGGED = {
    "loss_policy": "loss_objective",
    "loss_value": "loss_critic",
    "entropy": "entropy",
    "kl": "kl_approx",
    "clip_fraction": "clip_fraction",
    "ess": "ESS",
    "grad_norm": "norm",
}
"""Metrics logged as means over an iteration's gradient steps: name in the log -> key in the results
of `PPOLearner._policy_gradient`, completed by `PPOLearner._update`."""


def _minibatch(samples: TensorDict, rows: Tensor, keys: Sequence[str]) -> dict[str, Tensor]:
    """Return the given rows (M,) and columns; a dict, since a TensorDict slows PPO by 1%."""
    return {key: samples.get(key).index_select(0, rows) for key in keys}


_MOST_SAMPLES = 100_000
"""Largest minibatch size that an error message proposes."""


def check_batch(cfg: PPOCfg, num_envs: int) -> None:
    """Check that the minibatch size divides the samples of an iteration.

    Raises:
        ConfigError: if it does not; the message has the sizes.
    """
    samples, size = num_envs * cfg.steps_per_env, cfg.minibatch_size
    if samples % size:
        divisor = next(
            n for n in range(min(samples, size, _MOST_SAMPLES), 0, -1) if samples % n == 0
        )
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
    """Raise an error that names the first value of a gradient step that is not finite."""
    values = dict(zip(_LOGGED, logged.tolist(), strict=True))
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if bad:
        shown = ", ".join(f"{name} {value:g}" for name, value in values.items())
        raise RunError(
            f"{bad[0]} is not finite ({shown}); the step was not taken, the last checkpoint is "
            "good: try a lower algo.learning_rate"
        )
