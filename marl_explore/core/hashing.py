"""Counter-based random numbers: a hash of what a number is for replaces a generator's state.

The same inputs give the same number on any device, batch size, worker and torch version.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

_MASK = (1 << 64) - 1


def _signed(value: int) -> int:
    """The int64 with the bits of a 64-bit unsigned number."""
    value &= _MASK
    return value - (1 << 64) if value >> 63 else value


_GOLDEN = _signed(0x9E3779B97F4A7C15)
_MULTIPLY_1 = _signed(0xBF58476D1CE4E5B9)
_MULTIPLY_2 = _signed(0x94D049BB133111EB)


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical shift: int64 shifts drag the sign bit along."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(x: Tensor) -> Tensor:
    """Scramble int64 tensors of any shape by the finaliser of splitmix64."""
    x = x + _GOLDEN
    x = (x ^ _shift_right(x, 30)) * _MULTIPLY_1
    x = (x ^ _shift_right(x, 27)) * _MULTIPLY_2
    return x ^ _shift_right(x, 31)


def combine(*parts: Tensor | int) -> Tensor:
    """One int64 hash of several integers in their order; the parts broadcast."""
    result = torch.zeros((), dtype=torch.int64)
    for part in parts:
        if isinstance(part, Tensor):
            result = mix(result.to(part.device) ^ part)
        else:
            result = mix(result ^ _signed(part))
    return result


@lru_cache
def text_key(text: str) -> int:
    """A number for a name, such as a stream of arenas."""
    return int(combine(*text.encode()))


def stream_seed(stream: str, seed: int) -> int:
    """The seed of one stream: what generators of arenas are given as their seed."""
    return int(combine(text_key(stream), seed))
