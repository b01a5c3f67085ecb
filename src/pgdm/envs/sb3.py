"""The Stable-Baselines3 interface: N simulations as one ``VecEnv``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from pgdm.envs.batch_env import BatchEnv

Rows = int | Sequence[int] | None


class PgdmVecEnv(VecEnv):
    """A batch of one task as a Stable-Baselines3 ``VecEnv``; no process is started.

    Observations are float32 (N, D), actions float32 (N, A) in [-1, 1], rewards float32 (N,).
    Each row's ``info`` has ``object_error_m`` (m), ``success``, ``TimeLimit.truncated`` (the
    simulation diverged) and, when its episode ends, ``terminal_observation`` (D,), ``episode``
    with return ``r`` and length ``l``, and ``episode_metrics``.

    Args:
        batch: the task with ``auto_reset=True``.
    """

    def __init__(self, batch: BatchEnv) -> None:
        self.batch, self.render_mode = batch, None
        self._action = torch.zeros(batch.num_envs, batch.action_dim)
        super().__init__(
            batch.num_envs,
            spaces.Box(-np.inf, np.inf, (batch.obs_dim,), np.float32),
            spaces.Box(-1.0, 1.0, (batch.action_dim,), np.float32),
        )

    def reset(self) -> np.ndarray:
        """Restart all simulations; return observations (N, D).

        A seed given to ``seed`` restarts the randomisation here, in tasks that have it.
        """
        if (seed := self._seeds[0]) is not None:
            self.batch.reseed(seed)
        self._reset_seeds()
        self._reset_options()
        return self.batch.reset().numpy().copy()

    def step_async(self, actions: np.ndarray) -> None:
        """Store actions (N, A) for the next ``step_wait``."""
        self._action = torch.as_tensor(np.asarray(actions, np.float32))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Take one control step; return observations, rewards, ends (N,) bool and infos."""
        obs, reward, terminated, truncated, info = self.batch.step(self._action)
        done = terminated | truncated
        errors, success = info["object_error_m"].tolist(), info["success"].tolist()
        infos: list[dict[str, Any]] = [
            {"object_error_m": e, "success": s, "TimeLimit.truncated": False}
            for e, s in zip(errors, success, strict=True)
        ]
        metrics = {} if info["episodes"] is None else info["episodes"].metrics()
        for i, row in enumerate(done.nonzero()[:, 0].tolist()):
            own = {name: float(values[i]) for name, values in metrics.items()}
            infos[row] |= {
                "TimeLimit.truncated": bool(truncated[row]),
                "terminal_observation": info["final_obs"][row].numpy().copy(),
                "episode_metrics": own,
                "episode": {"r": own["return"], "l": int(own["length"])},
            }
        return obs.numpy().copy(), reward.numpy().copy(), done.numpy().copy(), infos

    def close(self) -> None:
        """Do nothing: the simulations end with this object."""

    def get_attr(self, attr_name: str, indices: Rows = None) -> list[Any]:
        """Return an attribute, the same for all rows."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Rows = None) -> None:
        """Set an attribute, for all rows."""
        del indices
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Rows = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once, for all rows; return its result for each."""
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Rows = None) -> list[bool]:
        """Return False for each row; ``infos`` hold episodes as SB3's ``Monitor`` would."""
        return [False] * len(list(self._get_indices(indices)))
