"""Check whether networks trained by gradient descent predict pre-grasps better than the linear fit.

    python benchmark/predictor_networks.py

Trains an ensemble of 8 small networks with Gaussian heads (64 hidden units, tanh; mean and standard
deviation of the first 10 principal components of the grasp vectors; noise on the codes and weight
decay against over-fitting), with the examples and the metric of ``predictor.py``: each object left
out in turn. Writes one JSON file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import torch
from predictor import RESULTS, cases
from torch import Tensor

from pgdm.pregrasp.predict.grasp_vector import JOINTS, POSITION, ROTATION, GraspFrame
from pgdm.pregrasp.predict.predictor import Example, anchored, fit, folds, off

MEMBERS, HIDDEN, COMPONENTS = 8, 64, 10
STEPS, LEARNING_RATE = 600, 3e-3
CODE_NOISE = 0.3  # in standard deviations of the codes
DECAYS = (0.3,)
COUNTS = (1, 8, 32)
NARROW, WIDE = -1.5, 1.5  # limits of the logarithm of the standard deviation


class Ensemble:
    """Networks trained in parallel on the same data, independent of each other.

    Args:
        codes: (n, B).
        vectors: (n, D).
        decay: weight decay.
        seed: seed of weights, batches and noise.
    """

    def __init__(self, codes: np.ndarray, vectors: np.ndarray, decay: float, seed: int = 0) -> None:
        self._random = torch.Generator().manual_seed(seed)
        x, y = torch.from_numpy(codes).float(), torch.from_numpy(vectors).float()
        self._code_mean, self._code_scale = x.mean(0), x.std(0).mean()
        self._mean, self._unit = y.mean(0), torch.empty(y.shape[1])
        self._unit[POSITION], self._unit[ROTATION], self._unit[JOINTS] = 0.02, 0.2, 0.3
        _, sizes, axes = torch.linalg.svd((y - self._mean) / self._unit, full_matrices=False)
        k = min(COMPONENTS, len(x) - 1)
        scale = sizes[:k] / len(x) ** 0.5
        self._axes = axes[:k].T * scale  # (D, k)
        z = ((y - self._mean) / self._unit) @ (axes[:k].T / scale)
        shapes = ((x.shape[1], HIDDEN), (1, HIDDEN), (HIDDEN, 2 * k), (1, 2 * k))
        sizes_ = (x.shape[1] ** -0.5, 0.0, 0.1 * HIDDEN**-0.5, 0.0)
        self._weights = [
            (size * self._normal(MEMBERS, *shape)).requires_grad_()
            for shape, size in zip(shapes, sizes_, strict=True)
        ]
        self._train((x - self._code_mean) / self._code_scale, z, decay)

    def sample(self, code: np.ndarray, count: int) -> np.ndarray:
        """Return grasp vectors (count, D), the ensemble's mean first."""
        x = (torch.from_numpy(code).float() - self._code_mean) / self._code_scale
        with torch.no_grad():
            mean, spread = self._heads(x.expand(MEMBERS, 1, -1))
        who = torch.randint(MEMBERS, (count,), generator=self._random)
        z = mean[who, 0] + spread[who, 0].exp() * self._normal(count, mean.shape[-1])
        z[0] = mean.mean(dim=(0, 1))
        return ((z @ self._axes.T) * self._unit + self._mean).double().numpy()

    def _train(self, x: Tensor, z: Tensor, decay: float) -> None:
        optimizer = torch.optim.AdamW(self._weights, lr=LEARNING_RATE, weight_decay=decay)
        for _ in range(STEPS):
            rows = torch.randint(len(x), (MEMBERS, len(x)), generator=self._random)
            seen = x[rows]
            mean, spread = self._heads(seen + CODE_NOISE * self._normal(*seen.shape))
            loss = (spread + 0.5 * ((z[rows] - mean) / spread.exp()) ** 2).mean(dim=(1, 2)).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    def _heads(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation, (M, n, k) each, at codes (M, n, B)."""
        first, bias, second, offset = self._weights
        out = torch.tanh(x @ first + bias) @ second + offset
        mean, spread = out.chunk(2, dim=-1)
        return mean, spread.clamp(NARROW, WIDE)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self._random)


def errors(frame: GraspFrame, examples: Sequence[Example], decay: float) -> dict[str, float]:
    """Return the mean fingertip error of the best of some samples, m."""
    codes = np.stack([e.code for e in examples])
    vectors = np.stack([anchored(e.vector, frame.anchor_m) for e in examples])
    found: dict[str, list[float]] = {f"best_of_{count}_m": [] for count in COUNTS}
    for held, rest in folds(examples):
        ensemble = Ensemble(codes[rest], vectors[rest], decay)
        for i in np.flatnonzero(held).tolist():
            away = [off(frame, v, examples[i]) for v in ensemble.sample(codes[i], max(COUNTS))]
            for count in COUNTS:
                found[f"best_of_{count}_m"].append(min(away[:count]))
    return {name: float(np.mean(values)) for name, values in found.items()}


def main() -> None:
    """Measure and write."""
    torch.set_num_threads(1)
    found = cases()
    examples = [one for _, _, one in found]
    frame = GraspFrame(found[0][0])
    frame = GraspFrame(found[0][0], fit(examples, frame).anchor_m)
    results = []
    for decay in DECAYS:
        results.append({"weight_decay": decay} | errors(frame, examples, decay))
        print(results[-1], flush=True)
    text = json.dumps(results, indent=1) + "\n"
    (RESULTS.parent / "predictor_networks.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
