"""Values of a rollout's observations, each computed once."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor


def write_shared_values(
    rollout: TensorDictBase, network: TensorDictModuleBase, key: NestedKey
) -> None:
    """Write the values of all observations and next observations into a rollout [*B, T].

    Most next observations are the observation of the step that follows, and have its value. The
    others, at the ends of episodes and of rows, are evaluated too. Where there is none, which
    collectors mark by NaN, the observation stands for it, as in TorchRL's GAE.

    Args:
        rollout: has what the network reads, also under "next".
        network: writes the value [*B, 1].
        key: of the value.
    """
    now = rollout.select(*network.in_keys)
    after = rollout["next"].select(*network.in_keys)
    value: Tensor = network(now.copy()).get(key)
    unshared = torch.ones(rollout.batch_size, dtype=torch.bool, device=value.device)
    unshared[..., :-1] = ~_equal(now[..., 1:], after[..., :-1])
    next_value = value.roll(-1, rollout.ndim - 1)
    ends = after[unshared].apply(lambda x, before: x.where(~x.isnan(), before), now[unshared])
    next_value[unshared] = network(ends).get(key)
    rollout.set(key, value)
    rollout.set(("next", key), next_value)


def _equal(one: TensorDictBase, other: TensorDictBase) -> Tensor:
    """Whether all entries [*B, ...] of two equal each other, bool [*B]."""
    entries = zip(one.values(True, True), other.values(True, True), strict=True)
    equal = [(a == b).unsqueeze(-1).flatten(one.ndim).all(-1) for a, b in entries]
    return torch.stack(equal).all(0)
