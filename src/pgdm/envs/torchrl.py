"""A task as a TorchRL environment: N simulations as one batched EnvBase."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from pgdm.envs.batch_env import BatchEnv


class PgdmTorchRLEnv(EnvBase):
    """A batch of one task as a TorchRL environment of batch size [N].

    Keys: ``observation`` (N, D) float32, ``action`` (N, A) in [-1, 1], ``reward`` (N, 1),
    ``terminated`` (the object was lost or the motion is over), ``truncated`` (the simulation
    diverged) and ``done``, (N, 1) bool; ``object_error_m`` (N, 1) m.

    Args:
        batch: the task with ``auto_reset=False``: TorchRL requests partial resets itself.
    """

    def __init__(self, batch: BatchEnv) -> None:
        n = batch.num_envs
        one = torch.Size([n, 1])
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([n]))
        self._batch = batch
        self.observation_spec = Composite(
            observation=Unbounded(torch.Size([n, batch.obs_dim]), dtype=torch.float32),
            object_error_m=Unbounded(one, dtype=torch.float32),
            shape=(n,),
        )
        self.action_spec = Bounded(
            -1.0, 1.0, torch.Size([n, batch.action_dim]), dtype=torch.float32
        )
        self.reward_spec = Unbounded(one, dtype=torch.float32)
        flag = Bounded(0, 1, one, dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,)
        )

    def warm_start(self) -> torch.Tensor:
        """Return the action (A,) at which a policy's mean starts; see `pgdm.mdp.actions`."""
        return self._batch.warm_start()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ids = None if mask is None else mask.reshape(-1).nonzero()[:, 0].numpy()
        obs = self._batch.reset(ids)
        return self._pack(obs, self._batch.object_error())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        obs, reward, terminated, truncated, info = self._batch.step(tensordict["action"])
        out = self._pack(obs, info["object_error_m"])
        out["reward"] = reward[:, None]
        out["terminated"], out["truncated"] = terminated[:, None], truncated[:, None]
        out["done"] = out["terminated"] | out["truncated"]
        return out

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._batch.reseed(seed)

    def _pack(self, obs: torch.Tensor, error: torch.Tensor) -> TensorDict:
        return TensorDict(
            {"observation": obs, "object_error_m": error.float()[:, None]}, batch_size=[len(obs)]
        )
