"""Random events of an episode: hashes of its key, the event's name and its indices.

So an episode is the same in any batch, in any worker and on any device.
"""

from __future__ import annotations

import math

from torch import Tensor

from marl_explore.core.hashing import combine, text_key

_BITS = 53


def episode_key(stream_seed: int, arena: Tensor, episode: Tensor) -> Tensor:
    """The key of episodes, int64 [*B], from arenas and episodes int64 [*B]."""
    return combine(stream_seed, arena, episode)


def uniform(key: Tensor, name: str, *indices: Tensor | int) -> Tensor:
    """Numbers in [0, 1), float64; the key int64 and the indices broadcast."""
    bits = combine(key, text_key(name), *indices)
    return ((bits >> (64 - _BITS)) & ((1 << _BITS) - 1)).double() / (1 << _BITS)


def happens(probability: float, key: Tensor, name: str, *indices: Tensor | int) -> Tensor:
    """Whether events of this probability happen, bool; the key and the indices broadcast."""
    return uniform(key, name, *indices) < probability


def normals(key: Tensor, name: str, *indices: int) -> list[float]:
    """Standard normal numbers of episodes, one per key int64 [A], after Box and Muller.

    Computed one by one: vectorised logarithms may differ in the last bit with the batch.
    """
    first, second = (uniform(key, name, *indices, part).tolist() for part in (0, 1))
    return [
        math.sqrt(-2 * math.log(1 - u)) * math.cos(2 * math.pi * v)
        for u, v in zip(first, second, strict=True)
    ]
