"""The random states that code of others draws from: kept apart, and given a seed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def own_chance() -> Iterator[None]:
    """What is drawn in this context from ``random``, numpy and torch leaves their states alone."""
    plain, arrays = random.getstate(), np.random.get_state()
    with torch.random.fork_rng(devices=[]):
        try:
            yield
        finally:
            random.setstate(plain)
            np.random.set_state(arrays)


def set_chance(key: int) -> None:
    """Let ``random``, numpy and torch draw from here on what follows from an int64."""
    seed = key % (1 << 64)
    random.seed(seed)
    np.random.seed(seed % (1 << 32))
    torch.default_generator.manual_seed(seed)
