"""Policies as one graph from observations to actuator targets: TorchScript and ONNX."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pgdm import paths
from pgdm.envs.build import EnvBuilder
from pgdm.export.description import description
from pgdm.export.trained import TrainedPolicy

KEY = "pgdm"
"""Key of the JSON description in ONNX's metadata and among TorchScript's extra files."""
INPUTS, OUTPUTS = ("observation", "step"), ("action", "ctrl")


class PolicyGraph(nn.Module):
    """A policy with its observation standardisation and action map.

    Args:
        policy: the policy.
        builder: builder of the policy's task.
    """

    inverse: Tensor

    def __init__(self, policy: TrainedPolicy, builder: EnvBuilder) -> None:
        super().__init__()
        self.network, self.actions = policy.network, builder.mdp.actions
        order = np.argsort(builder.scene.index.actuators)  # each actuator's entry of the action
        self.register_buffer("inverse", torch.from_numpy(order))

    def forward(self, observation: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean action and its actuator targets.

        Args:
            observation: (N, D) float32.
            step: (N,) int64, control steps since reset, 0 to T-2.

        Returns:
            Actions (N, A) float32, in the order of the hand's driven joints, not yet clipped to
            [-1, 1]; MuJoCo's ``ctrl`` for the clipped actions, (N, nu) float64, m and rad.
        """
        action = self.network.mean(observation)
        return action, self.actions.act(action, step)[:, self.inverse]


def _examples(graph: PolicyGraph) -> tuple[Tensor, Tensor]:
    return torch.zeros(2, graph.network.cfg.obs_dim), torch.zeros(2, dtype=torch.int64)


def write_torchscript(policy: TrainedPolicy, builder: EnvBuilder, path: Path) -> None:
    """Write `PolicyGraph` as a TorchScript module, atomically.

    ``torch.jit.load(path, _extra_files={"pgdm": ""})`` reads it.

    Raises:
        OSError: if the file cannot be written.
    """
    graph = PolicyGraph(policy, builder).eval()
    extra = {KEY: json.dumps(description(policy, builder))}
    with _quiet(), torch.no_grad(), paths.replacing(path) as temp:
        traced = torch.jit.trace(graph, _examples(graph), check_trace=False)
        torch.jit.save(traced, str(temp), _extra_files=extra)


def write_onnx(policy: TrainedPolicy, builder: EnvBuilder, path: Path) -> None:
    """Write an ONNX model with inputs ``INPUTS`` and outputs ``OUTPUTS``, atomically.

    Raises:
        OSError: if the file cannot be written.
    """
    graph = PolicyGraph(policy, builder).eval()
    rows = torch.export.Dim("N")
    with _quiet(), torch.no_grad():
        program: Any = torch.onnx.export(
            graph,
            _examples(graph),
            input_names=INPUTS,
            output_names=OUTPUTS,
            dynamic_shapes={name: {0: rows} for name in INPUTS},
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    entry = model.metadata_props.add()
    entry.key, entry.value = KEY, json.dumps(description(policy, builder))
    with paths.replacing(path) as temp:
        temp.write_bytes(model.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence torch's warnings about its exporters."""
    exporter = logging.getLogger("torch.onnx")
    before = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(before)
