from __future__ import annotations

import numpy as np
import torch

from pgdm.rl.normalizer import Normalizer
from pgdm.seeding import torch_stream


def test_statistics_equal_numpy_over_all_batches() -> None:
    generator = torch_stream(0, "test")
    scale = torch.tensor([1e-3, 1.0, 1e3])
    batches = [
        scale * torch.randn(n, 3, generator=generator) + shift
        for n, shift in ((7, 5.0), (1, 0.0), (300, -2.0), (64, 1e3))
    ]
    normalizer = Normalizer(3, clip=10.0)
    for batch in batches:
        normalizer.update(batch)
    everything = torch.cat(batches).double().numpy()
    assert float(normalizer.count) == len(everything)
    np.testing.assert_allclose(normalizer.mean.numpy(), everything.mean(0), rtol=1e-12)
    np.testing.assert_allclose(normalizer.var.numpy(), everything.var(0), rtol=1e-9)


def test_output_is_standardised_and_clipped() -> None:
    normalizer = Normalizer(1, clip=2.0)
    normalizer.update(torch.tensor([[1.0], [3.0]]))  # mean 2, variance 1
    out = normalizer(torch.tensor([[2.0], [3.0], [0.5], [9.0], [-9.0]]))
    torch.testing.assert_close(out[:, 0], torch.tensor([0.0, 1.0, -1.5, 2.0, -2.0]))
    assert out.dtype == torch.float32


def test_before_the_first_update_it_only_clips() -> None:
    out = Normalizer(2, clip=10.0)(torch.tensor([[0.25, 40.0]]))
    torch.testing.assert_close(out, torch.tensor([[0.25, 10.0]]))


def test_a_constant_entry_becomes_zero() -> None:
    normalizer = Normalizer(1, clip=10.0)
    normalizer.update(torch.full((5, 1), 3.0))
    assert float(normalizer(torch.tensor([[3.0]]))) == 0.0


def test_reading_does_not_change_the_statistics() -> None:
    normalizer = Normalizer(1, clip=10.0)
    normalizer.update(torch.tensor([[1.0], [3.0]]))
    before = {name: value.clone() for name, value in normalizer.state_dict().items()}
    normalizer(torch.tensor([[100.0]]))
    assert all(torch.equal(value, before[name]) for name, value in normalizer.state_dict().items())
