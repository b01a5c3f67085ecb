"""Trains a task with pgdm's collector and loss: python torchrl_ppo.py [FRAMES]."""

import sys

import torch
from torch import nn
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import MLP, ValueOperator

import pgdm
from pgdm.rl.actor import GaussianActor
from pgdm.rl.collector import RolloutCollector
from pgdm.rl.loss import ProximalPolicyLoss

total_frames = int(sys.argv[1]) if len(sys.argv) > 1 else 200_000
torch.manual_seed(0)  # initial weights, order of the samples
env = pgdm.make_batch("hammer-use1", num_envs=64, action="residual")

layers = {"num_cells": [256, 128], "activation_class": nn.Tanh}
actor = GaussianActor(
    MLP(env.obs_dim, env.action_dim, **layers),
    nn.Parameter(torch.full((env.action_dim,), -1.6)),
)
critic = ValueOperator(MLP(env.obs_dim, 1, **layers), in_keys=["observation"])
with torch.no_grad():
    actor.net[-1].weight.mul_(0.01)
    actor.net[-1].bias.copy_(env.warm_start())

collector = RolloutCollector(env, actor, frames_per_batch=4096, total_frames=total_frames)
loss = ProximalPolicyLoss(actor, critic, entropy_coeff=0.001, critic_coeff=0.5)
loss.make_value_estimator(gamma=0.95, lmbda=0.95)
samples = TensorDictReplayBuffer(
    storage=LazyTensorStorage(4096), sampler=SamplerWithoutReplacement(), batch_size=256
)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4)

for rollout in collector:
    with torch.no_grad():
        samples.extend(loss.value_estimator(rollout).reshape(-1))
    for _ in range(5):
        for minibatch in samples:
            out = loss(minibatch)
            (out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
            optimizer.zero_grad()
    print(f"reward {collector.metrics['reward']:.3f}, episodes {collector.metrics['episodes']:.0f}")
collector.shutdown()
