"""Trains a task with TorchRL's own components: python torchrl_collector.py [FRAMES]."""

import sys

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import pgdm

total_frames = int(sys.argv[1]) if len(sys.argv) > 1 else 200_000
torch.manual_seed(0)  # initial weights, actions, order of the samples
env = pgdm.make_torchrl("hammer-use1", num_envs=64, action="residual")
obs_dim, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]

layers = {"num_cells": [256, 128], "activation_class": nn.Tanh}
mean = MLP(obs_dim, action_dim, **layers)
with torch.no_grad():
    mean[-1].weight.mul_(0.01)
    mean[-1].bias.copy_(env.warm_start())
net = nn.Sequential(mean, AddStateIndependentNormalScale(action_dim, scale_mapping="exp"))
nn.init.constant_(net[-1].state_independent_scale, -1.6)
actor = ProbabilisticActor(
    TensorDictModule(net, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
critic = ValueOperator(MLP(obs_dim, 1, **layers), in_keys=["observation"])

collector = Collector(
    env,
    actor,
    frames_per_batch=4096,
    total_frames=total_frames,
    auto_register_policy_transforms=False,  # neither the env nor the policy needs any
)
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.001, critic_coeff=0.5, normalize_advantage=True)
advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic)
samples = TensorDictReplayBuffer(
    storage=LazyTensorStorage(4096), sampler=SamplerWithoutReplacement(), batch_size=256
)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4)

for rollout in collector:
    print(f"reward {rollout['next', 'reward'].mean():.3f}")
    with torch.no_grad():
        samples.extend(advantage(rollout).reshape(-1))
    for _ in range(5):
        for minibatch in samples:
            out = loss(minibatch)
            (out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
            optimizer.zero_grad()
collector.shutdown()

env.reset()
with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
    rollout = env.rollout(200, actor)  # until the first simulation ends
print(f"mean action: reward {rollout['next', 'reward'].mean():.3f}")
