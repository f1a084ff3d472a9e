"""What robots of a team know about each other, and which frontiers are left to each."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import NUM_DIRECTIONS, other_robots
from marl_explore.core.information_gain import TERRITORY_SIZE, territory_table
from marl_explore.transforms.base import LinkedFeature, TeamMapFeature

NEAR_CELLS, FEW_CELLS, SHORT_STEPS = 8, 16, 8
"""Scales at which distances, unshared cells and waiting times are resolved best."""


class FrontierTerritory(TeamMapFeature):
    """The frontiers to which no other linked robot is nearer, by direction.

    Reads maps int8 [*B, N, H, W] and positions int64 [*B, N, 2]; writes float32 [*B, N, 8, 5]
    (``core.information_gain.territory_table``).

    Args:
        map_key: entry with the maps of a team.
        position_key: entry with the (row, column) positions.
        out_key: entry to write.
        range_cells: largest distance at which robots are linked (cells), for data without links.
        radius: of the square that a robot sees (cells).
        linked_key: entry with the links, bool [*B, N, N]; None: compute them from the range.
        sight: of the robots, instead of that square (``ArenaConfig.sight``).
    """

    def __init__(
        self,
        map_key: NestedKey = ("agents", "map"),
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "territory"),
        range_cells: float = 6.4,
        radius: int = 1,
        linked_key: NestedKey | None = None,
        sight: Sight | None = None,
    ) -> None:
        super().__init__([map_key, position_key], out_key, range_cells, linked_key, position=1)
        self.sight = Sight.square(radius) if sight is None else sight

    def compute(self, *inputs: Tensor) -> Tensor:
        """The table float32 [*B, N, 8, 5]."""
        grid, position = inputs[:2]
        return territory_table(grid, position, self.links_of(inputs), self.sight)

    def feature_spec(self, grid: TensorSpec, position: TensorSpec, *_: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, N, 8, 5]."""
        shape = (*position.shape[:-1], NUM_DIRECTIONS, TERRITORY_SIZE)
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)


class Teammates(LinkedFeature):
    """What each robot knows about every other one: where it is, and what was exchanged with it.

    Reads positions int64 [*B, N, 2], own discoveries since the last merge int64 [*B, N, N] (q_ij)
    and steps since then (s) int64 [*B, N, N]; writes float32 [*B, N, N, 6]: 1 for linked robots;
    their relative row and column over 8 cells, at most 1, and 1 / distance (all 0 if not linked);
    q / (q + 16) and s / (s + 8). All are 0 for the robot itself.

    Args:
        position_key: entry with the (row, column) positions.
        unshared_key: entry with q_ij.
        since_key: entry with the steps since the last merge.
        out_key: entry to write.
        range_cells: largest distance at which robots are linked (cells), for data without links.
        linked_key: entry with the links, bool [*B, N, N]; None: compute them from the range.
    """

    def __init__(
        self,
        position_key: NestedKey = ("agents", "position"),
        unshared_key: NestedKey = ("agents", "unshared"),
        since_key: NestedKey = ("agents", "steps_since_merge"),
        out_key: NestedKey = ("agents", "observation", "teammates"),
        range_cells: float = 6.4,
        linked_key: NestedKey | None = None,
    ) -> None:
        super().__init__([position_key, unshared_key, since_key], out_key, range_cells, linked_key)

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Require positions int64 [*B, N, 2], links bool and the others int64 [*B, N, N]."""
        super().check_kinds(*inputs)
        position = inputs[0]
        shape = (*position.shape[:-1], position.shape[-2])
        for key, entry in zip(self.in_keys[1:3], inputs[1:3], strict=True):
            if (entry.dtype, entry.shape) != (torch.int64, shape):
                self._refuse(key, f"int64 of shape {shape}", entry)

    def compute(self, *inputs: Tensor) -> Tensor:
        """The features float32 [*B, N, N, 6]."""
        position, unshared, since = inputs[:3]
        others = other_robots(position.shape[-2], position.device)
        near = (self.links_of(inputs) * others).float()
        offset = (position.unsqueeze(-3) - position.unsqueeze(-2)).float()
        distance = offset.norm(dim=-1).clamp_min(1)
        place = (offset / NEAR_CELLS).clamp(-1, 1) * near.unsqueeze(-1)
        return torch.stack(
            (
                near,
                *place.unbind(-1),
                near / distance,
                (unshared / (unshared + FEW_CELLS)).float() * others,
                (since / (since + SHORT_STEPS)).float() * others,
            ),
            -1,
        )

    def feature_spec(self, position: TensorSpec, *_: TensorSpec) -> TensorSpec:
        """Bounds -1 and 1, shape [*B, N, N, 6]."""
        shape = (*position.shape[:-1], position.shape[-2], 6)
        return Bounded(-1, 1, shape=shape, dtype=torch.float32, device=position.device)
