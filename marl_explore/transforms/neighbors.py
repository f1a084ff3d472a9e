"""NET: which robots are within communication range."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from marl_explore.core.radio import in_range
from marl_explore.transforms.base import FeatureTransform, require_range


class CommunicationNeighbors(FeatureTransform):
    """Whether each pair of robots is in communication range; a robot is in range of itself.

    Reads positions int64 [*B, N, 2] (cells) and writes float32 [*B, N, N] of 0 and 1.

    Args:
        position_key: entry with the (row, column) positions of a team.
        out_key: entry to write.
        range_cells: largest distance of cell centres (cells; may be infinite).

    Raises:
        ValueError: for a negative range, or positions of another dtype or shape.
        KeyError: when the entry is missing; it names those that are there.
    """

    def __init__(
        self,
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "net"),
        range_cells: float = 6.4,
    ) -> None:
        require_range(range_cells)
        super().__init__([position_key], out_key)
        self.range_cells = range_cells

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Positions must be int64 [*B, N, 2]."""
        (position,) = inputs
        self._require_team(self.in_keys[0], position)

    def compute(self, position: Tensor) -> Tensor:  # type: ignore[override]
        """NET float32 [*B, N, N] of positions [*B, N, 2]."""
        return in_range(position, self.range_cells).float()

    def feature_spec(self, position: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, N, N]."""
        shape = (*position.shape[:-1], position.shape[-2])
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)
