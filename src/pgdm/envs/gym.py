"""The Gymnasium interface: one simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.film import goal, renderer
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.sim.batch import Data, Model
from pgdm.sim.render import Renderer

if TYPE_CHECKING:
    from pgdm.sim.viewer import Window


class PgdmEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One task as a Gymnasium environment.

    Observations are float32 (D,) in the chosen layout, actions float32 (A,) in [-1, 1].
    ``terminated``: the object was lost or the motion ended; ``truncated``: the simulation
    diverged. ``info`` holds ``object_error_m`` (m), ``success`` (whether that error is
    within the threshold) and, when an episode ends, ``episode_metrics``.

    Args:
        batch: the task with one simulation and ``auto_reset=False``.
        render_mode: ``rgb_array``; ``human``, which shows each state in a window; or None.

    Raises:
        RenderError: if the mode is ``human`` and no window can be opened.
    """

    # The frame rate of most tasks; __init__ sets that of the given task.
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium's form)

    def __init__(self, batch: BatchEnv, render_mode: str | None = None) -> None:
        self._batch = batch
        self.metadata = {**self.metadata, "render_fps": round(1 / batch.sim.control_dt_s)}
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-np.inf, np.inf, (batch.obs_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (batch.action_dim,), np.float32)
        self._renderer: Renderer | None = None
        self._window: Window | None = None
        if render_mode == "human":
            from pgdm.sim.viewer import Window  # needs a screen

            self._window = Window(self.model, "render_mode='rgb_array'")

    @property
    def model(self) -> Model:
        """MuJoCo's model of the scene."""
        return self._batch.sim.scene.model

    @property
    def data(self) -> Data:
        """MuJoCo's data in the current state; a copy, so writing to it has no effect."""
        return self._batch.sim.data(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Restart the episode.

        Args:
            seed: seed of the randomisation at resets, in tasks that have it.
            options: ``{"reach": True}`` starts at the reset pose and carries out the reach, as in
                deployment; the episode starts where the reach ends.

        Raises:
            ConfigError: if an option is unknown or invalid, or no plan leads to the start state.
            RunError: if the reach diverges.
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
        self._show()
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
        self._show()
        return row, float(reward[0]), bool(terminated[0]), bool(truncated[0]), out

    def render(self) -> np.ndarray | None:
        """Return the current picture, (H, W, 3) uint8, the target drawn as a translucent object.

        None unless the mode is ``rgb_array``; a window is updated by every reset and step.
        """
        if self.render_mode != "rgb_array":
            return None
        reference = self._batch.mdp.reference
        if self._renderer is None:
            self._renderer = renderer(self._batch.sim.scene, reference)
        return self._renderer.render(self.data, goal(reference, int(self._batch.t[0])))

    def _show(self) -> None:
        if self._window is not None and self._window.is_open:
            self._window.show(self.data.qpos, self._batch.sim.control_dt_s)

    def close(self) -> None:
        """Free the renderer, close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
