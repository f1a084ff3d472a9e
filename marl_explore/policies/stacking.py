"""Networks of equal structure with separate weights, run as one network.

A loop over robots spends its time on call overhead and on matrix products with few rows, which are
slow. Stacked copies of the weights need one batched product per layer.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn


class UnknownLayerError(TypeError):
    """A layer whose weights ``stack_modules`` cannot stack."""


def stack_modules(networks: Sequence[nn.Module]) -> nn.Module:
    """One module that applies network i to row i of its inputs [N, *B, ...].

    It holds copies of the weights as they are now, without gradients.

    Args:
        networks: N modules of one kind, made of Linear, LayerNorm and Conv2d layers and of
            modules without parameters that take any batch dimensions.

    Raises:
        UnknownLayerError: naming a layer with parameters that is of another kind.
    """
    first = networks[0]
    for kind, stack in _STACKS.items():
        if isinstance(first, kind):
            return stack(networks)
    if any(True for _ in first.parameters(recurse=False)):
        known = ", ".join(kind.__name__ for kind in _STACKS)
        raise UnknownLayerError(f"{type(first).__name__} cannot be stacked: only {known} can")
    together = copy.copy(first)
    together._modules = {
        name: stack_modules([network.get_submodule(name) for network in networks])
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
    """Convolutions as one grouped convolution, [N, *B, C, H, W] to [N, *B, C', H', W']."""

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
