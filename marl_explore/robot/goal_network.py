"""The actor that chooses among goals, in numpy: ``policies.networks.goals.GoalActor``."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_explore.config.checks import require_integer, require_positive
from marl_explore.config.fields import check_type
from marl_explore.config.goals import (
    COMPUTED,
    CONTEXT_SIZE,
    FRONTIER_SIZE,
    MATE_SIZE,
    PAIR_SIZE,
    PLACE,
    SENSOR,
    STILL_SIZE,
)
from marl_explore.robot.candidates import Candidates
from marl_explore.robot.goal_features import FeatureScaling, GoalFeatures
from marl_explore.robot.networks import Array, Weights

_WEIGHTS, _RIVAL_SCALE, _MEMORY = 22, 12, 16
"""Weights of the utility, and those of them that it divides by."""
_ABOUT = [0, 1, 2, 3]
_BESIDE = [4, 7, 5, 6]
"""Columns of what multiplies ``Pairs.about`` and ``Pairs.beside``."""
_PLACES = [COMPUTED.index(name) for name in PLACE]


class GoalNetwork:
    """Features and logits of one robot's choices.

    Args:
        weights: of a ``GoalActor`` by name, float32.
        options: ``code_width``, ``pair_width``, ``refinement``, ``home_cells``,
            ``communicate_every``, ``communicate_after`` and, if it is there, ``reads_sensor`` of
            ``policies.networks.Goals``.

    Raises:
        ValueError: when an option is not a number in its range, or a weight is missing, has
            another shape, or is not known.
        KeyError: when an option is missing.
    """

    def __init__(self, weights: Weights, options: dict[str, Any]) -> None:
        for name in ("code_width", "pair_width", "communicate_every", "home_cells"):
            require_integer(name, options[name], 1)
        require_integer("communicate_after", options["communicate_after"], 0)
        check_type("refinement", options["refinement"], float)
        require_positive("refinement", options["refinement"])
        reads_sensor = options.get("reads_sensor", False)
        check_type("reads_sensor", reads_sensor, bool)
        own = CONTEXT_SIZE + len(SENSOR) * reads_sensor
        _check_shapes(weights, options["code_width"], options["pair_width"], own)
        self.features = FeatureScaling(
            weights["encoder.features.weights"],
            options["communicate_every"],
            options["communicate_after"],
            reads_sensor,
        )
        self._pair = _Layer.split(weights, "encoder.pair.0", _ABOUT)
        self._beside = np.ascontiguousarray(weights["encoder.pair.0.weight"][:, _BESIDE])
        self._second = _Layer(weights, "encoder.pair.2")
        self._frontier = _frontier_weight(weights, own)
        contexts = ("encoder.frontier.0", "encoder.mate.0", "encoder.still.0")
        self._contexts = [_Layer.split(weights, name, np.s_[-own:]) for name in contexts]
        self._mate = weights["encoder.mate.0.weight"][:, :MATE_SIZE]
        self._still = weights["encoder.still.0.weight"][:, :STILL_SIZE]
        self._code = _Layer(weights, "encoder.code.0")
        width = options["code_width"]
        self._score = weights["score.0.weight"][:, :width]
        self._pooled = _Layer.split(weights, "score.0", np.s_[width:])
        self._last = weights["score.2.weight"][0]  # its bias does not change what is left of it
        self._refinement, self._home_cells = float(options["refinement"]), options["home_cells"]
        self._prior = weights["prior"]

    def __call__(self, found: Candidates) -> tuple[list[int], Array]:
        """The numbers of the choices that there are, and their logits float32."""
        features = self.features(found)
        return features.choices, self.logits(features, found.context.cells)

    def logits(self, features: GoalFeatures, cells: int) -> Array:
        """Logits of the choices in an arena of so many cells, float32."""
        kinds = (self._places(features), features.mate, features.still)
        weights = (self._frontier, self._mate, self._still)
        first = np.empty((len(self._score), len(features.choices)), np.float32)
        begin = 0
        for inputs, weight, layer in zip(kinds, weights, self._contexts, strict=True):
            if not inputs.shape[1]:
                continue
            end = begin + inputs.shape[1]
            np.add(weight @ inputs, layer(features.context)[:, None], out=first[:, begin:end])
            begin = end
        each = _rectified(self._code.of_columns(_rectified(first)))
        pooled = np.concatenate((np.add.reduce(each, 1) / each.shape[1], each.max(1)))
        hidden = self._score @ each
        hidden += self._pooled(pooled)[:, None]
        weight = self._last
        score: Array = weight @ _rectified(hidden)
        score -= score[features.prior.argmax()]
        score /= self._refinement
        np.tanh(score, out=score)
        score *= np.float32(self._refinement)
        homes = np.float32(max(1.0, cells / self._home_cells))
        score += homes * self._prior * features.prior
        return score

    def _places(self, features: GoalFeatures) -> Array:
        """Features of candidate frontiers, with the mean and maximum of codes of teammates."""
        places, (about, beside) = features.frontier, features.pairs
        mates, number = beside.shape[1:]
        pairs = len(self._beside)
        inputs = np.zeros((len(places) + 2 * pairs, number), np.float32)
        inputs[: len(places)] = places
        if mates and number:
            first = (self._beside @ beside.reshape(len(beside), -1)).reshape(pairs, mates, number)
            first += self._pair.of_columns(about)[:, :, None]
            codes = _rectified(self._second.of_columns(_rectified(first).reshape(pairs, -1)))
            codes = codes.reshape(pairs, mates, number)
            mean, most = inputs[len(places) : -pairs], inputs[-pairs:]
            np.add.reduce(codes, 1, out=mean)
            mean /= mates
            np.maximum.reduce(codes, 1, out=most)
        return inputs


class _Layer:
    """A linear layer.

    Args:
        weights: of the network.
        name: of the layer.
    """

    def __init__(self, weights: Weights, name: str) -> None:
        self.weight, self.bias = weights[f"{name}.weight"], weights[f"{name}.bias"]

    @classmethod
    def split(cls, weights: Weights, name: str, inputs: slice | list[int]) -> _Layer:
        """A layer that reads only some of the inputs."""
        layer = cls(weights, name)
        layer.weight = np.ascontiguousarray(layer.weight[:, inputs])
        return layer

    def __call__(self, inputs: Array) -> Array:
        """Outputs [O] of inputs [I]."""
        outputs: Array = self.weight @ inputs
        outputs += self.bias
        return outputs

    def of_columns(self, inputs: Array) -> Array:
        """Outputs [O, C] of inputs [I, C]."""
        outputs: Array = self.weight @ inputs
        outputs += self.bias[:, None]
        return outputs


def _rectified(values: Array) -> Array:
    """The values, with 0 in place of negative ones."""
    return np.maximum(values, 0, out=values)


def _frontier_weight(weights: Weights, own: int) -> Array:
    """What multiplies the features of frontiers as they are computed, and the codes of pairs."""
    weight = weights["encoder.frontier.0.weight"]
    pooled = weight[:, FRONTIER_SIZE:-own]
    places = np.zeros((len(weight), len(COMPUTED)), np.float32)
    places[:, _PLACES] = weight[:, :FRONTIER_SIZE]
    return np.concatenate((places, pooled), 1)


def _check_shapes(weights: Weights, width: int, pair: int, own: int) -> None:
    layers: dict[str, tuple[int, ...]] = {
        "encoder.pair.0": (pair, PAIR_SIZE),
        "encoder.pair.2": (pair, pair),
        "encoder.frontier.0": (width, FRONTIER_SIZE + 2 * pair + own),
        "encoder.mate.0": (width, MATE_SIZE + own),
        "encoder.still.0": (width, STILL_SIZE + own),
        "encoder.code.0": (width, width),
        "score.0": (width, 3 * width),
        "score.2": (1, width),
    }
    shapes: dict[str, tuple[int, ...]] = {"encoder.features.weights": (_WEIGHTS,), "prior": ()}
    for name, shape in layers.items():
        shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    if unknown := weights.keys() - shapes.keys():
        raise ValueError(f"it has {min(unknown)}, which is not known")
    for name, shape in shapes.items():
        found = weights[name].shape if name in weights else None
        if found != shape:
            raise ValueError(f"{name} of shape {found} must have {shape}")
    utility = weights["encoder.features.weights"]
    if not utility[[_RIVAL_SCALE, _MEMORY]].all():
        raise ValueError("the utility's rival_scale and memory must not be 0")
