"""Measure the time of a loss and its gradient on one thread, for rows of ``throughput.py``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import SoftUpdate
from torchrl_loss import clip_ppo_loss

from pgdm.config.compose import compose
from pgdm.config.schema import ExperimentCfg
from pgdm.rl.actor import GaussianActor
from pgdm.rl.loss import ProximalPolicyLoss
from pgdm.rl.networks import ActionValue, ActorCritic, NetworkCfg, SquashedCfg, SquashedPolicy
from pgdm.rl.ppo import PPOCfg
from pgdm.rl.sac import SACCfg
from pgdm.rl.sac_loss import SoftActorCriticLoss

REPEATS = 64


def gradient_step_ms(cfg: ExperimentCfg) -> tuple[float, float, float]:
    """Return the time of one minibatch's PPO loss and gradient on one thread, ms.

    Of pgdm's loss in two halves, as its learner computes it; of its ``forward``; and of the
    ``forward`` of TorchRL's ``ClipPPOLoss``.
    """
    algo = cfg.algo
    assert isinstance(algo, PPOCfg)
    m, obs_dim, action_dim = algo.minibatch_size, 322, 30
    network = NetworkCfg(obs_dim, action_dim, list(algo.hidden), algo.log_std_init, False, 10.0)
    model = ActorCritic(network, torch.Generator().manual_seed(0))
    actor = GaussianActor(model.policy, model.log_std)
    batch = actor(TensorDict({"observation": torch.randn(m, obs_dim)}, [m])).detach()
    batch["advantage"], batch["value_target"] = torch.randn(2, m, 1)
    own = ProximalPolicyLoss(
        actor,
        TensorDictModule(model.critic, ["observation"], ["state_value"]),
        clip_epsilon=algo.clip,
        entropy_coeff=algo.entropy_coef,
        critic_coeff=algo.value_coef,
        normalize_advantage=algo.normalize_advantage,
    )
    theirs = clip_ppo_loss(model, algo)

    def in_halves() -> Tensor:
        out = own.loss_policy(batch)
        return out["loss_objective"] + out["loss_entropy"] + own.loss_critic(batch)[0]

    def whole(loss: Callable[[TensorDict], TensorDict]) -> Tensor:
        out = loss(batch)
        return out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]

    ways = (in_halves, lambda: whole(own), lambda: whole(theirs))
    spent = [0.0] * len(ways)
    for _ in range(REPEATS):
        for number, way in enumerate(ways):
            model.zero_grad()
            start = time.perf_counter()
            way().backward()
            spent[number] += time.perf_counter() - start
    halves, forward, torchrls = (1e3 * seconds / REPEATS for seconds in spent)
    return halves, forward, torchrls


def critic_gradient_ms(cfg: ExperimentCfg) -> tuple[float, float]:
    """Return the time of one batch's critic loss and gradient, one by one and under vmap, ms."""
    algo, generator = cfg.algo, torch.Generator().manual_seed(0)
    assert isinstance(algo, SACCfg)
    m, obs_dim, action_dim = algo.batch_size, 322, 30
    network = SquashedCfg("squashed", obs_dim, action_dim, list(algo.hidden), -1.6, 10.0)
    policy = SquashedPolicy(network, generator)
    critics = [ActionValue(obs_dim, action_dim, algo.hidden, generator) for _ in range(2)]
    after = {name: torch.zeros(m, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after |= {"observation": torch.randn(m, obs_dim), "reward": torch.rand(m, 1)}
    columns = {"observation": torch.randn(m, obs_dim), "action": torch.rand(m, action_dim)}
    batch = TensorDict({**columns, "next": TensorDict(after, batch_size=m)}, batch_size=m)
    spent = []
    for vmap in (False, True):
        loss = SoftActorCriticLoss(
            policy,
            critics,
            gamma=algo.gamma,
            temperature=0.01,
            target_entropy=-30.0,
            generator=generator,
        )
        SoftUpdate(loss, tau=0.01)  # without a value estimator the loss warns
        loss.deactivate_vmap = not vmap
        loss._make_vmap()
        params, times = list(loss.qvalue_network_params.parameters()), []
        for _ in range(REPEATS):
            start = time.perf_counter()
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=algo.bfloat16):
                value = loss.critic_loss(batch)
            torch.autograd.grad(value, params)
            times.append(time.perf_counter() - start)
        spent.append(1e3 * statistics.median(times))
    return spent[0], spent[1]


def measure_losses(task: str) -> dict[str, float]:
    """Return one value of each row about a loss and its gradient, on one thread."""
    one_by_one, under_vmap = critic_gradient_ms(compose([f"task={task}", "algo=sac"]))
    in_halves, whole, torchrls = gradient_step_ms(compose([f"task={task}"]))
    return {
        "SAC's critics, loss and gradient (ms)": one_by_one,
        "the same under TorchRL's vmap (ms)": under_vmap,
        "PPO, loss and gradient in two halves (ms)": in_halves,
        "the same by the loss's forward (ms)": whole,
        "the same by TorchRL's ClipPPOLoss (ms)": torchrls,
    }
