"""Numpy versions of the networks for robots: the same logits from the same weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Weights = Mapping[str, Array]
_EPSILON = 1e-5  # of torch's layer normalisation


def _layers(weights: Weights, prefix: str) -> list[str]:
    """Names of a sequence's layers with weights, in order."""
    own = [name.removeprefix(f"{prefix}.") for name in weights if name.startswith(f"{prefix}.")]
    return [f"{prefix}.{number}" for number in sorted({int(name.split(".")[0]) for name in own})]


def _flat(array: Array, dims: int) -> Array:
    return array.reshape(*array.shape[: array.ndim - dims], -1)


def _linear(weights: Weights, name: str, inputs: Array) -> Array:
    outputs: Array = inputs @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]
    return outputs


def mlp(weights: Weights, fov: Array, fpr: Array, net: Array) -> Array:
    """``MLPActor``: layers identified by their shapes, ReLU after each linear one but the last."""
    values = np.concatenate((_flat(fov, 2), _flat(fpr, 2), net), -1)
    names = _layers(weights, "layers")
    for name in names:
        if weights[f"{name}.weight"].ndim == 1:
            values = _normalized(weights, name, values)
            continue
        values = _linear(weights, name, values)
        if name != names[-1]:
            values = np.maximum(values, 0)
    return values


def _normalized(weights: Weights, name: str, values: Array) -> Array:
    scale, shift = weights[f"{name}.weight"], weights[f"{name}.bias"]
    if scale.shape != values.shape[-1:]:  # numpy would broadcast a scale of length 1
        raise ValueError(f"{name}.weight of shape {scale.shape} must have {values.shape[-1:]}")
    centred: Array = values - values.mean(-1, keepdims=True)
    spread = np.sqrt((centred * centred).mean(-1, keepdims=True) + np.float32(_EPSILON))
    return centred / spread * scale + shift


def cnn(weights: Weights, fov: Array, fpr: Array, net: Array) -> Array:
    """``CNNActor``: convolutions on FOV, layers on FPR and NET, then the head."""
    image = fov[..., None, :, :]
    *convolutions, last = _layers(weights, "encoder.fov")
    for name in convolutions:
        image = _convolved(image, weights[f"{name}.weight"], weights[f"{name}.bias"])
        image = np.maximum(image, 0)
    parts = (
        _linear(weights, last, _flat(image, 3)),
        _linear(weights, "encoder.fpr.0", _flat(fpr, 2)),
        _linear(weights, "encoder.net.0", net),
    )
    values = np.maximum(np.concatenate(parts, -1), 0)
    return _linear(weights, "head.2", np.maximum(_linear(weights, "head.0", values), 0))


def _convolved(image: Array, kernel: Array, bias: Array) -> Array:
    """3 x 3 kernels [O, I, 3, 3] over [*B, I, H, W], with a border of zeros: [*B, O, H, W]."""
    border = [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, border), (3, 3), (-2, -1))
    summed: Array = np.tensordot(windows, kernel, ((-5, -2, -1), (1, 2, 3))) + bias
    return np.moveaxis(summed, -1, -3)


TWINS: dict[str, Callable[..., Array]] = {"mlp": mlp, "cnn": cnn}
"""From (weights, fov, fpr, net) to logits [*B, 10], by ``Network.exported_as``."""
