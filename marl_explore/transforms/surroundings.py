"""Features of a robot's own map around it, and the shared clock."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import (
    NUM_DIRECTIONS,
    OCCUPIED,
    UNKNOWN,
    flat_cell,
    square_steps,
)
from marl_explore.core.information_gain import shape_sizes, step_gains
from marl_explore.core.links import linked_others
from marl_explore.transforms.base import FeatureTransform, MapFeature, TeamMapFeature

LONG_STEPS = 16
"""Number of elapsed steps that is scaled to one half."""
CLOCK_PERIOD = 6
"""Period of the clock (steps)."""
LOCAL_VIEW = 4
"""Cells of the local map on each side of a robot."""


class StepGain(MapFeature):
    """Share of the cells of its sensor's shape that a robot would newly see after each move.

    Reads maps int8 [*B, H, W] and positions int64 [*B, 2]; writes float32 [*B, 8], 0 where the
    move is known to be blocked.

    Args:
        map_key: entry with the maps.
        position_key: entry with the (row, column) positions.
        out_key: entry to write.
        radius: of the square that a robot sees (cells).
        sight: of the robots, instead of that square (``ArenaConfig.sight``); if their sensors
            differ, the last batch dimension must be that of the robots.
    """

    def __init__(
        self,
        map_key: NestedKey = ("agents", "map"),
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "gain"),
        radius: int = 1,
        sight: Sight | None = None,
    ) -> None:
        super().__init__([map_key, position_key], out_key)
        self.sight = Sight.square(radius) if sight is None else sight

    def compute(self, grid: Tensor, position: Tensor) -> Tensor:  # type: ignore[override]
        """The shares float32 [*B, 8]."""
        gains = step_gains(grid, position, self.sight)
        return gains / shape_sizes(self.sight, grid.device)

    def feature_spec(self, grid: TensorSpec, position: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, 8]."""
        shape = (*position.shape[:-1], NUM_DIRECTIONS)
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)


class LocalMap(TeamMapFeature):
    """The part of its map around each robot of a team, and the linked robots in it.

    Reads maps int8 [*B, N, H, W] and positions int64 [*B, N, 2]; writes float32
    [*B, N, 3, 2r + 1, 2r + 1]: unknown cells; occupied cells and cells outside; linked robots.

    Args:
        map_key: entry with the maps of a team.
        position_key: entry with the (row, column) positions.
        out_key: entry to write.
        range_cells: largest distance at which robots are linked (cells), for data without links.
        view: r, half the side of the part (cells).
        linked_key: entry with the links, bool [*B, N, N]; None: compute them from the range.
    """

    def __init__(
        self,
        map_key: NestedKey = ("agents", "map"),
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "local"),
        range_cells: float = 6.4,
        view: int = LOCAL_VIEW,
        linked_key: NestedKey | None = None,
    ) -> None:
        super().__init__([map_key, position_key], out_key, range_cells, linked_key, position=1)
        self.view = view

    def compute(self, *inputs: Tensor) -> Tensor:
        """The part float32 [*B, N, 3, 2r + 1, 2r + 1]."""
        grid, position = inputs[:2]
        side = 2 * self.view + 1
        padded = torch.nn.functional.pad(grid, (self.view,) * 4, value=OCCUPIED)
        stride = padded.shape[-1]
        centre = flat_cell(position + self.view, stride).unsqueeze(-1)
        part = padded.flatten(-2).gather(-1, centre + square_steps(self.view, stride, grid.device))
        offset = position.unsqueeze(-3) - position.unsqueeze(-2) + self.view
        seen = ((offset >= 0) & (offset < side)).all(-1) & linked_others(self.links_of(inputs))
        cell = torch.where(seen, flat_cell(offset, side), side * side)
        robots = part.new_zeros(*part.shape[:-1], side * side + 1).scatter(-1, cell, 1)
        layers = (part == UNKNOWN, part == OCCUPIED, robots[..., :-1] > 0)
        return torch.stack(layers, -2).float().unflatten(-1, (side, side))

    def feature_spec(self, grid: TensorSpec, position: TensorSpec, *_: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, N, 3, 2r + 1, 2r + 1]."""
        side = 2 * self.view + 1
        shape = (*position.shape[:-1], 3, side, side)
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)


class Clock(FeatureTransform):
    """The time since the episode's start, for every robot of a team.

    Reads the step count t, int64 [*B, 1], and, for the number of robots, positions int64
    [*B, N, 2]; writes float32 [*B, N, 1 + period]: t / (t + 16), and t modulo the period, one-hot.

    Args:
        step_key: entry with the step count.
        position_key: entry with the positions.
        out_key: entry to write.
        period: of the clock (steps).
    """

    def __init__(
        self,
        step_key: NestedKey = "step_count",
        position_key: NestedKey = ("agents", "position"),
        out_key: NestedKey = ("agents", "observation", "clock"),
        period: int = CLOCK_PERIOD,
    ) -> None:
        super().__init__([step_key, position_key], out_key)
        self.period = period

    def check_kinds(self, *inputs: Tensor | TensorSpec) -> None:
        """Require steps int64 [*B, 1] and positions int64 [*B, N, 2]."""
        steps, position = inputs
        self._require_team(self.in_keys[1], position)
        shape = (*position.shape[:-2], 1)
        if (steps.dtype, steps.shape) != (torch.int64, shape):
            self._refuse(self.in_keys[0], f"int64 of shape {shape}", steps)

    def compute(self, steps: Tensor, position: Tensor) -> Tensor:  # type: ignore[override]
        """The time float32 [*B, N, 1 + period]."""
        hand = torch.nn.functional.one_hot(steps.squeeze(-1) % self.period, self.period)
        time = torch.cat(((steps / (steps + LONG_STEPS)).float(), hand), -1)
        return time.unsqueeze(-2).expand(*position.shape[:-1], -1).contiguous()

    def feature_spec(self, steps: TensorSpec, position: TensorSpec) -> TensorSpec:
        """Bounds 0 and 1, shape [*B, N, 1 + period]."""
        shape = (*position.shape[:-1], 1 + self.period)
        return Bounded(0, 1, shape=shape, dtype=torch.float32, device=position.device)
