"""Stacks of layers and how they are initialised."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import nn

ACTOR_GAIN, CRITIC_GAIN = 0.01, 1.0


def relu() -> nn.ReLU:
    """A rectifier that overwrites its input, which the layer before needs for no gradient."""
    return nn.ReLU(inplace=True)


def mlp(
    inputs: int,
    outputs: int,
    hidden: Sequence[int],
    norm_last: bool,
    gain: float,
) -> nn.Sequential:
    """Linear layers with ReLU, separated by layer normalisation (the paper's Table I).

    Args:
        inputs: features in.
        outputs: features out.
        hidden: widths of the hidden layers.
        norm_last: whether the last hidden layer is normalised too.
        gain: scale of the orthogonal initialisation of the last layer.
    """
    layers: list[nn.Module] = []
    for index, width in enumerate(hidden):
        layers += [nn.Linear(inputs, width), relu()]
        if norm_last or index < len(hidden) - 1:
            layers.append(nn.LayerNorm(width))
        inputs = width
    layers.append(nn.Linear(inputs, outputs))
    return initialize(nn.Sequential(*layers), gain)


def initialize(network: nn.Sequential, gain: float) -> nn.Sequential:
    """Orthogonal weights (gain sqrt 2, ``gain`` in the last layer) and zero biases."""
    layers = [m for m in network.modules() if isinstance(m, (nn.Linear, nn.Conv2d))]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else math.sqrt(2))
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
    return network
