"""Counter-based random numbers: hashes of their purpose, instead of a generator with a state.

The same inputs give the same number for any device, batch size, worker and torch version.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

_MASK = (1 << 64) - 1


def _signed(value: int) -> int:
    """The int64 with the bits of an unsigned 64-bit number."""
    value &= _MASK
    return value - (1 << 64) if value >> 63 else value


_GOLDEN = _signed(0x9E3779B97F4A7C15)
_MULTIPLY_1 = _signed(0xBF58476D1CE4E5B9)
_MULTIPLY_2 = _signed(0x94D049BB133111EB)


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical right shift; shifting an int64 would copy the sign bit."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(x: Tensor) -> Tensor:
    """Hash int64 tensors of any shape with the finaliser of splitmix64."""
    x = x + _GOLDEN
    x = (x ^ _shift_right(x, 30)) * _MULTIPLY_1
    x = (x ^ _shift_right(x, 27)) * _MULTIPLY_2
    return x ^ _shift_right(x, 31)


def combine(*parts: Tensor | int) -> Tensor:
    """One int64 hash of several integers, in order; the parts broadcast."""
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
    """The seed of one stream, which is passed to arena generators."""
    return int(combine(text_key(stream), seed))
