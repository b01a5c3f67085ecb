"""The Gymnasium face: one simulation."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgdm.envs.batch_env import BatchEnv
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.sim.batch import Data, Model
from pgdm.sim.render import Renderer


class PgdmEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One task as a Gymnasium environment.

    Observations are float32 (D,) in the chosen layout, actions float32 (A,) in [-1, 1].
    ``terminated``: the object was lost or the motion ended; ``truncated``: the simulation
    diverged. ``info`` holds ``object_error_m`` (m), ``success`` (the step is within the
    threshold) and, at an episode's end, ``episode_metrics``.

    Args:
        batch: the task with one simulation and ``auto_reset=False``.
        render_mode: ``rgb_array`` or None.
    """

    # The speed of most tasks; hammer-strike's own is set below.
    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium's form)

    def __init__(self, batch: BatchEnv, render_mode: str | None = None) -> None:
        self._batch = batch
        self.metadata = {**self.metadata, "render_fps": round(1 / batch.sim.control_dt_s)}
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-np.inf, np.inf, (batch.obs_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (batch.action_dim,), np.float32)
        self._renderer: Renderer | None = None

    @property
    def model(self) -> Model:
        """MuJoCo's model of the scene."""
        return self._batch.sim.scene.model

    @property
    def data(self) -> Data:
        """MuJoCo's data in the current state: a copy, writing to it changes nothing."""
        return self._batch.sim.data(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Restart the episode.

        Args:
            seed: matters only to tasks that vary per reset.
            options: ``{"reach": True}`` begins at the hand's reset pose and carries out the plan
                that leads to the start, as in deployment; the episode begins where it ends.

        Raises:
            ConfigError: if an option is unknown, or no plan leads to the start.
        """
        super().reset(seed=seed)
        asked = options or {}
        if wrong := sorted(set(asked) - {"reach"}):
            raise UnknownNameError("reset option", wrong[0], ["reach"])
        if not isinstance(asked.get("reach", False), bool):
            raise ConfigError(f"reset option 'reach' is {asked['reach']!r}; valid: True, False")
        if seed is not None:
            self._batch.reseed(seed)
        obs = self._batch.reach() if asked.get("reach") else self._batch.reset()
        return obs[0].numpy().copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one control step."""
        tensor = torch.as_tensor(np.asarray(action, np.float32))[None]
        obs, reward, terminated, truncated, info = self._batch.step(tensor)
        out: dict[str, Any] = {
            "object_error_m": float(info["object_error_m"][0]),
            "success": bool(info["success"][0]),
        }
        if (finished := info["episodes"]) is not None:
            out["episode_metrics"] = {k: float(v[0]) for k, v in finished.metrics().items()}
        row = obs[0].numpy().copy()
        return row, float(reward[0]), bool(terminated[0]), bool(truncated[0]), out

    def render(self) -> np.ndarray | None:
        """Return the current picture, (H, W, 3) uint8, the goal drawn as a ghost."""
        if self.render_mode is None:
            return None
        reference = self._batch.mdp.reference
        if self._renderer is None:
            scene = self._batch.sim.scene
            motion = reference.pos.numpy()
            self._renderer = Renderer(scene.model, scene.index.object_body, motion=motion)
        t = int(self._batch.t[0])
        return self._renderer.render(
            self.data, (reference.pos[t].numpy(), reference.quat[t].numpy())
        )

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
