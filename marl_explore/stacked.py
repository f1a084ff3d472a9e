"""Equal networks with weights of their own, run side by side as one network.

A loop over robots spends its time on calls, and products with few rows on reading weights in an
order that suits many. Stacked copies of the weights make one batched product per layer.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn


def side_by_side(networks: Sequence[nn.Module]) -> nn.Module:
    """One module that applies network i to row i of its inputs [N, *B, ...].

    It holds copies of the weights as they are now, without gradients.

    Args:
        networks: N modules of one architecture, of Linear, LayerNorm and Conv2d layers and of
            modules without parameters that take any batch dimensions.

    Raises:
        TypeError: naming a layer with parameters that is none of these.
    """
    first = networks[0]
    for kind, stack in _STACKS.items():
        if isinstance(first, kind):
            return stack(networks)
    if any(True for _ in first.parameters(recurse=False)):
        raise TypeError(f"{type(first).__name__} cannot be run side by side: {[*_STACKS]} can")
    together = copy.copy(first)
    together._modules = {
        name: side_by_side([network.get_submodule(name) for network in networks])
        for name, _ in first.named_children()
    }
    return together


def _weights(networks: Sequence[Any], name: str) -> Tensor:
    return torch.stack([getattr(network, name).detach() for network in networks])


class _Linears(nn.Module):
    """Linear layers, [N, *B, in] to [N, *B, out]."""

    def __init__(self, layers: Sequence[Any]) -> None:
        super().__init__()
        self.weight = _weights(layers, "weight").transpose(1, 2).contiguous()
        self.bias = _weights(layers, "bias").unsqueeze(1)

    def forward(self, inputs: Tensor) -> Tensor:
        rows = inputs.flatten(1, -2)
        return torch.baddbmm(self.bias, rows, self.weight).unflatten(1, inputs.shape[1:-1])


class _LayerNorms(nn.Module):
    """Layer normalisations over the last dimension of [N, *B, features]."""

    def __init__(self, layers: Sequence[Any]) -> None:
        super().__init__()
        self.weight, self.bias = _weights(layers, "weight"), _weights(layers, "bias")
        self.eps = layers[0].eps

    def forward(self, inputs: Tensor) -> Tensor:
        shape = (len(inputs), *[1] * (inputs.ndim - 2), -1)
        normed = nn.functional.layer_norm(inputs, inputs.shape[-1:], eps=self.eps)
        return torch.addcmul(self.bias.view(shape), normed, self.weight.view(shape))


class _Convolutions(nn.Module):
    """Convolutions as groups of one, [N, *B, C, H, W] to [N, *B, C', H', W']."""

    def __init__(self, layers: Sequence[Any]) -> None:
        super().__init__()
        self.weight = _weights(layers, "weight").flatten(0, 1)
        self.bias = _weights(layers, "bias").flatten()
        self.options = {"stride": layers[0].stride, "padding": layers[0].padding}

    def forward(self, inputs: Tensor) -> Tensor:
        networks, *batch = inputs.shape[:-3]
        channels = inputs.flatten(1, -4).transpose(0, 1).flatten(1, 2)
        outputs = nn.functional.conv2d(
            channels, self.weight, self.bias, groups=networks, **self.options
        )
        return outputs.unflatten(1, (networks, -1)).transpose(0, 1).unflatten(1, batch)


_STACKS: dict[type[nn.Module], Callable[[Sequence[Any]], nn.Module]] = {
    nn.Linear: _Linears,
    nn.LayerNorm: _LayerNorms,
    nn.Conv2d: _Convolutions,
}
