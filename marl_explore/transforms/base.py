"""Base classes of the feature transforms: several input entries, one feature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import Transform

from marl_explore.core.grid import FREE, OCCUPIED, UNKNOWN
from marl_explore.core.links import within_range

_CODES = f"{UNKNOWN} unknown, {FREE} free, {OCCUPIED} occupied"


def require_range(range_cells: float) -> None:
    """Require a number of at least 0."""
    if not isinstance(range_cells, (int, float)) or not range_cells >= 0:  # NaN too
        raise ValueError(f"range_cells={range_cells!r} is not allowed: it must be a number >= 0")


class FeatureTransform(Transform):
    """Computes one feature from several entries of a TensorDict, with any batch dimensions.

    A subclass implements ``check_kinds``, ``compute`` and ``feature_spec``. On an environment the
    feature is part of every observation. Called on a TensorDict (as an nn.Module, or on samples of
    a replay buffer), it is written at the root and, if the inputs are there too, under "next".

    Raises:
        ValueError: when ``out_key`` is one of ``in_keys``.
    """

    def __init__(self, in_keys: Sequence[NestedKey], out_key: NestedKey) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        if self.out_keys[0] in self.in_keys:
            raise ValueError(f"out_key={out_key!r} is not allowed: it would replace an input")
        self._vouched = False

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Raise an error for entries, or their specs, with a wrong dtype or shape."""
        raise NotImplementedError

    def compute(self, *inputs: Tensor) -> Tensor:
        """The feature, from the entries named by ``in_keys``."""
        raise NotImplementedError

    def feature_spec(self, *inputs: TensorSpec) -> TensorSpec:
        """The spec of the feature, from the specs of the entries named by ``in_keys``."""
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._inputs(next_tensordict)
        return next_tensordict.set(self.out_keys[0], self._checked(inputs, not self._vouched))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the feature into a TensorDict, at the root and under "next"."""
        following = tensordict.get("next", None)
        if following is not None and all(following.get(k, None) is not None for k in self.in_keys):
            self._write(following)
        return self._write(tensordict)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        feature = self._checked(self._inputs(tensordict), values=True)
        return tensordict.set(self.out_keys[0], feature)

    def _checked(self, inputs: Sequence[Tensor], values: bool) -> Tensor:
        self.check_kinds(*inputs)
        if values:
            self.check_values(*inputs)
        return self.compute(*inputs)

    def check_values(self, *inputs: Tensor) -> None:
        """Raise an error for values that are not allowed."""

    def vouch(self, *inputs: TensorSpec) -> bool:
        """Whether the specs of an environment guarantee that ``check_values`` passes."""
        return True

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # the caller discards rows that are not reset: compute only the others
        flagged = tensordict.get("_reset", None)
        if flagged is None or flagged.all():
            return self._call(tensordict_reset)
        rows = flagged.reshape(tensordict_reset.shape).nonzero(as_tuple=True)
        inputs = [entry[rows] for entry in self._inputs(tensordict_reset)]
        fresh = self._checked(inputs, not self._vouched)
        feature = fresh.new_zeros(*tensordict_reset.shape, *fresh.shape[1:])
        return tensordict_reset.set(self.out_keys[0], feature.index_put(rows, fresh))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the feature's spec to the observation spec."""
        inputs = self._entries(observation_spec, "the observation spec of the environment")
        self.check_kinds(*inputs)
        self._vouched = self.vouch(*inputs)
        observation_spec[self.out_keys[0]] = self.feature_spec(*inputs)
        return observation_spec

    def _inputs(self, tensordict: TensorDictBase) -> list[Tensor]:
        return self._entries(tensordict, "the TensorDict")

    def _entries(self, holder: Any, name: str) -> list[Any]:
        """The entries named by ``in_keys``, from a TensorDict or a spec."""
        entries = []
        for key in self.in_keys:
            entry = holder.get(key, None)
            if entry is None or isinstance(entry, (TensorDictBase, Composite)):
                what = "is not in" if entry is None else "is a group of entries in"
                present = ", ".join(sorted(map(str, holder.keys(True, True)))) or "nothing"
                raise KeyError(
                    f"{type(self).__name__} needs the entry {key!r}, which {what} {name}; it "
                    f"holds {present}"
                )
            entries.append(entry)
        return entries

    def _require_team(self, key: NestedKey, position: Tensor | TensorSpec) -> None:
        """Require positions of a team, int64 [*B, N, 2]."""
        if position.dtype != torch.int64 or position.ndim < 2 or position.shape[-1] != 2:
            self._refuse(key, "int64 of shape [*B, N, 2] (row, column of every robot)", position)

    def _refuse(self, key: NestedKey, needed: str, entry: Tensor | TensorSpec) -> NoReturn:
        raise ValueError(
            f"{type(self).__name__}: {key!r} must be {needed}, got {entry.dtype} of shape "
            f"{tuple(entry.shape)} on {entry.device}"
        )


class LinkedFeature(FeatureTransform):
    """A feature that depends on links, which it reads from an entry or computes from a range.

    Args:
        in_keys: further entries to read; one of them holds the positions of a team.
        out_key: entry to write.
        range_cells: largest distance of cell centres at which robots are linked (cells; may be
            infinite), for data without links.
        linked_key: entry with the links, bool [*B, N, N]; None: compute them from the range.
        position: index of the positions among ``in_keys``.

    Raises:
        ValueError: for a negative range.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
        range_cells: float,
        linked_key: NestedKey | None,
        position: int = 0,
    ) -> None:
        require_range(range_cells)
        super().__init__([*in_keys, *([] if linked_key is None else [linked_key])], out_key)
        self.range_cells, self.linked_key, self._position = range_cells, linked_key, position

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Require positions int64 [*B, N, 2] and links bool [*B, N, N]."""
        position = inputs[self._position]
        self._require_team(self.in_keys[self._position], position)
        if self.linked_key is not None:
            shape = (*position.shape[:-1], position.shape[-2])
            if (inputs[-1].dtype, inputs[-1].shape) != (torch.bool, shape):
                self._refuse(self.linked_key, f"bool of shape {shape} (linked pairs)", inputs[-1])

    def links_of(self, inputs: Sequence[Tensor]) -> Tensor:
        """The links, bool [*B, N, N], from all inputs."""
        if self.linked_key is None:
            return within_range(inputs[self._position], self.range_cells)
        return inputs[-1]


class MapFeature(FeatureTransform):
    """A feature of maps int8 [*B, H, W] (-1 unknown, 0 free, 1 occupied) and a position in each.

    They are the entries named by ``in_keys``, in this order; positions are int64 [*B, 2]. If the
    feature is ``of_team``, the shapes are [*B, N, H, W] and [*B, N, 2].
    """

    of_team = False

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Require maps and positions of these dtypes and shapes, on one device."""
        grid, position = inputs[:2]
        if grid.dtype != torch.int8 or grid.ndim < 2 + self.of_team or 0 in grid.shape[-2:]:
            axes = "[*B, N, H, W]" if self.of_team else "[*B, H, W]"
            self._refuse(self.in_keys[0], f"int8 of shape {axes} with {_CODES}", grid)
        shape = (*grid.shape[:-2], 2)
        kind = (position.dtype, position.shape, position.device)
        if kind != (torch.int64, shape, grid.device):
            on = f" on {grid.device}" if grid.device is not None else ""
            self._refuse(
                self.in_keys[1], f"int64 of shape {shape} (row, column of every map){on}", position
            )

    def check_values(self, *inputs: Tensor) -> None:
        """Require that maps hold only the three cell values, and that positions are inside them."""
        grid, position = inputs[:2]
        other = (grid < UNKNOWN) | (grid > OCCUPIED)
        if other.any():
            raise ValueError(
                f"{type(self).__name__}: {self.in_keys[0]!r} holds {grid[other][0].item()}, which "
                f"is not a cell value: {_CODES}"
            )
        height, width = grid.shape[-2:]
        size = torch.tensor([height, width], device=position.device)
        outside = ((position < 0) | (position >= size)).any(-1)
        if outside.any():
            cell = tuple(position[outside][0].tolist())
            raise ValueError(
                f"{type(self).__name__}: {self.in_keys[1]!r} holds {cell}, which is outside the "
                f"map of {height} x {width} cells"
            )

    def vouch(self, *inputs: TensorSpec) -> bool:
        """Whether the specs' bounds allow only the three cell values and positions in the map."""
        grid, position = inputs[:2]
        last = torch.tensor(grid.shape[-2:], device=position.device) - 1
        return within(grid, UNKNOWN, OCCUPIED) and within(position, 0, last)


class TeamMapFeature(MapFeature, LinkedFeature):
    """A feature of a team's maps, positions and links."""

    of_team = True

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """The checks of both base classes."""
        MapFeature.check_kinds(self, *inputs)
        LinkedFeature.check_kinds(self, *inputs)


def within(spec: TensorSpec, low: Tensor | int, high: Tensor | int) -> bool:
    """Whether a spec's bounds are at least as tight as these."""
    if not isinstance(spec, Bounded):
        return False
    return bool((spec.low >= low).all() and (spec.high <= high).all())
