"""What torch has once per process: its number of threads and its global random stream."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use ``count`` threads inside the block.

    While simulations step, torch gets one thread: its helper threads (libgomp) keep their cores
    busy for about 4 ms after each call, and the simulation's threads need these cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def drawing_from(generator: torch.Generator, device: torch.device | None = None) -> Iterator[None]:
    """Let draws from torch's global stream come from ``generator`` inside the block.

    TorchRL's policies and losses can draw from the global stream only. The stream of a CUDA
    ``device`` cannot be replaced, so it is seeded from the generator instead.
    """
    cuda = device is not None and device.type == "cuda"
    with torch.random.fork_rng([device] if cuda else []):
        if cuda:
            torch.cuda.manual_seed(int(torch.randint(2**62, (), generator=generator)))
        torch.set_rng_state(generator.get_state())
        yield
        generator.set_state(torch.get_rng_state())


class Aside:
    """A second thread for work that can overlap with the caller's; torch uses one thread there.

    Args:
        name: name of the thread.
        wanted: whether to start it; if not, work runs when its result is requested.
    """

    def __init__(self, name: str, wanted: bool) -> None:
        self._pool = None
        if wanted:
            one = {"initializer": torch.set_num_threads, "initargs": (1,)}
            self._pool = ThreadPoolExecutor(1, name, **one)

    def __call__(self, work: Callable[[], T]) -> Callable[[], T]:
        """Start work; return a function that waits for its result."""
        return work if self._pool is None else self._pool.submit(work).result

    def close(self) -> None:
        """Stop the thread once its work is done."""
        if self._pool is not None:
            self._pool.shutdown()
