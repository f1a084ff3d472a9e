"""FPR: how many frontiers lie in each direction, and how far away they are."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from marl_explore.config.constants import NUM_FEATURES
from marl_explore.core import frontier, native
from marl_explore.core.frontier import NORMALIZATIONS, Normalization
from marl_explore.core.grid import NUM_DIRECTIONS
from marl_explore.core.native import BACKENDS, Backend, operator
from marl_explore.transforms.base import MapFeature


class FrontierReachability(MapFeature):
    """The 8 x 3 table of paths to the frontiers of each robot's map (Algorithm 1).

    Reads maps int8 [*B, H, W] (-1 unknown, 0 free, 1 occupied) and positions int64 [*B, 2];
    writes float32 [*B, 8, 3]: number, mean length and standard deviation of the shortest paths to
    frontiers whose first move goes N, NE, E, SE, S, SW, W, NW.

    Args:
        map_key: entry with the maps.
        position_key: entry with the (row, column) positions.
        out_key: entry to write.
        normalize: "relative", "proximity", "absolute" or None for cells.
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible). The
            results are bit-identical.
        levels: maximum path length (cells), only with torch. It fixes the number of operations, so
            that a GPU is never synchronised; None: all paths.

    Raises:
        ValueError: for an unknown normalisation or backend, for entries with another dtype or
            shape, for other cell values, and for positions outside the map.
        KeyError: when an entry is missing, listing the existing ones.
        RuntimeError: when the native backend is requested and cannot be used.
    """

    def __init__(
        self,
        map_key: NestedKey = ("agents", "map"),
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "fpr"),
        normalize: Normalization | None = "relative",
        backend: Backend = "auto",
        levels: int | None = None,
    ) -> None:
        if normalize not in NORMALIZATIONS:
            raise ValueError(f"normalize={normalize!r} is not one of {NORMALIZATIONS}")
        if backend not in BACKENDS:
            raise ValueError(f"backend={backend!r} is not one of {BACKENDS}")
        if levels is not None and (levels < 1 or backend == "native"):
            raise ValueError(f"levels={levels!r} is not allowed: at least 1, without 'native'")
        if backend == "native" and (reason := native.missing()):
            raise RuntimeError(f"backend='native' cannot be used: {reason}")
        super().__init__([map_key, position_key], out_key)
        self.normalize: Normalization | None = normalize
        self.backend = backend
        self.levels = levels

    def compute(self, *inputs: Tensor) -> Tensor:
        """The feature table float32 [*B, 8, 3] of maps [*B, H, W] and positions [*B, 2]."""
        grid, position = inputs
        if self._is_native(grid):
            return operator.feature_table(grid, position, self.normalize)
        return frontier.feature_table(grid, position, self.normalize, self.levels)

    def _is_native(self, grid: Tensor) -> bool:
        if self.backend == "auto":
            return grid.device.type == "cpu" and self.levels is None and native.missing() is None
        return self.backend == "native"

    def feature_spec(self, grid: TensorSpec, position: TensorSpec) -> TensorSpec:
        """Bounds of the table: 1 if normalised by the robot's own longest path."""
        height, width = grid.shape[-2:]
        high = 1 if self.normalize in ("relative", "proximity") else height * width
        shape = (*grid.shape[:-2], NUM_DIRECTIONS, NUM_FEATURES)
        return Bounded(0, high, shape=shape, dtype=torch.float32, device=grid.device)
