"""The common shape of our transforms: several input entries, one feature."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform


class FeatureTransform(Transform):
    """Computes one feature from several entries of a TensorDict, with any batch dimensions.

    A subclass gives ``compute`` and ``feature_spec``. On an environment the feature is part of
    every observation; called on a TensorDict (as an nn.Module, or on samples of a replay buffer)
    it is written at the root and, where the inputs are there too, under "next".
    """

    def __init__(self, in_keys: Sequence[NestedKey], out_key: NestedKey) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])

    def compute(self, *inputs: Tensor) -> Tensor:
        """The feature of the entries named by ``in_keys``."""
        raise NotImplementedError

    def feature_spec(self, *inputs: TensorSpec) -> TensorSpec:
        """Spec of the feature, given the specs of the entries named by ``in_keys``."""
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._inputs(next_tensordict)
        return next_tensordict.set(self.out_keys[0], self.compute(*inputs))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the feature into a TensorDict, at the root and under "next"."""
        following = tensordict.get("next", None)
        if following is not None and all(following.get(k, None) is not None for k in self.in_keys):
            self._call_checked(following)
        return self._call_checked(tensordict)

    def _call_checked(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_values(*self._inputs(tensordict))
        return self._call(tensordict)

    def check_values(self, *inputs: Tensor) -> None:
        """Refuse values of data from elsewhere; on an environment its specs vouch for them."""

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # rows that are not reset are thrown away by the caller: compute the others only
        flagged = tensordict.get("_reset", None)
        if flagged is None or flagged.all():
            return self._call(tensordict_reset)
        rows = flagged.reshape(tensordict_reset.shape).nonzero(as_tuple=True)
        fresh = self.compute(*(entry[rows] for entry in self._inputs(tensordict_reset)))
        feature = fresh.new_zeros(*tensordict_reset.shape, *fresh.shape[1:])
        return tensordict_reset.set(self.out_keys[0], feature.index_put(rows, fresh))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the feature's spec to the observation spec."""
        inputs = [observation_spec[key] for key in self.in_keys]
        observation_spec[self.out_keys[0]] = self.feature_spec(*inputs)
        return observation_spec

    def _inputs(self, tensordict: TensorDictBase) -> list[Tensor]:
        inputs = []
        for key in self.in_keys:
            entry = tensordict.get(key, None)
            if entry is None:
                present = sorted(map(str, tensordict.keys(True, True)))
                raise KeyError(
                    f"{type(self).__name__} needs the entry {key!r}, which is not in the "
                    f"TensorDict; it holds {', '.join(present)}"
                )
            inputs.append(entry)
        return inputs

    def _require_cells(self, position: Tensor, robots: torch.Size) -> None:
        """Positions must be int64 [*robots, 2]."""
        if position.dtype != torch.int64 or position.shape != (*robots, 2):
            raise ValueError(
                f"{type(self).__name__}: {self.in_keys[-1]!r} must be int64 of shape "
                f"{(*robots, 2)} (row, column), got {position.dtype} of shape "
                f"{tuple(position.shape)}"
            )
