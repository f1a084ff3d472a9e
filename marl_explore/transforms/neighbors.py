"""NET: which robots are in communication range."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from marl_explore.transforms.base import LinkedFeature


class CommunicationNeighbors(LinkedFeature):
    """Whether each pair of robots can communicate; 1 on the diagonal.

    Reads positions int64 [*B, N, 2] (cells) and writes float32 [*B, N, N] of 0 and 1.

    Args:
        position_key: entry with the (row, column) positions of a team.
        out_key: entry to write.
        range_cells: largest distance of cell centres (cells; may be infinite), for data without
            links.
        linked_key: entry with the links, bool [*B, N, N]; None: compute them from the range.

    Raises:
        ValueError: for a negative range, or entries with another dtype or shape.
        KeyError: when the entry is missing, listing the existing ones.
    """

    def __init__(
        self,
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "net"),
        range_cells: float = 6.4,
        linked_key: NestedKey | None = None,
    ) -> None:
        super().__init__([position_key], out_key, range_cells, linked_key)

    def compute(self, *inputs: Tensor) -> Tensor:
        """NET float32 [*B, N, N], from positions [*B, N, 2] or from links."""
        return self.links_of(inputs).float()

    def feature_spec(self, position: TensorSpec, *_: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, N, N]."""
        shape = (*position.shape[:-1], position.shape[-2])
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)
