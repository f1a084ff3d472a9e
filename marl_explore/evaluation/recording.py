"""What measures need of episodes, recorded step by step."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import STAY
from marl_explore.core.links import any_linked
from marl_explore.core.mapping import (
    finishable,
    known_mask,
    known_targets,
    target_cells,
    union_of,
)
from marl_explore.core.survivors import smallest_of_living
from marl_explore.evaluation.metrics import Episodes, Snapshot, snapshot

EVENTS = ("dangerous", "merged", "discovered", "received", "linked")
"""Entries that are 0 after the end of an episode."""
STATES = ("position", "alive")
"""Entries that stay as they were."""


class _Step(NamedTuple):
    """What is kept of a step of b arenas."""

    rows: Tensor
    """Their numbers, int64 [b]."""
    maps: Snapshot
    entries: dict[str, Tensor]


class _Now(NamedTuple):
    """What is asked of the last observation at the end of an episode."""

    grid: Tensor
    alive: Tensor
    position: Tensor
    union_targets: Tensor


class Recording:
    """Episodes of B arenas.

    Args:
        config: of the arenas.
        start: the observation of the reset, batch [B].
        shared: whether all robots count as having the union of the maps.
        until_mapped: whether an episode ends as soon as the map of every living robot is complete,
            or none lives: what comes after does not count.
    """

    def __init__(
        self,
        config: ArenaConfig,
        start: TensorDictBase,
        shared: bool = False,
        until_mapped: bool = False,
    ) -> None:
        self._config, self._shared, self._until_mapped = config, shared, until_mapped
        self._obstacles = start["obstacles"]
        self._target = target_cells(self._obstacles, start["agents", "position"])
        self._num_targets = self._target.flatten(-2).sum(-1)
        num_arenas = len(self._num_targets)
        self._rows = torch.arange(num_arenas, device=start.device)
        self._ended = torch.full_like(self._num_targets, -1)
        self._finishable = torch.zeros_like(self._num_targets, dtype=torch.bool)
        self._lost = torch.zeros_like(self._num_targets)
        self._steps: list[_Step] = []
        self.add(start)

    def add(self, observation: TensorDictBase) -> None:
        """The next observation, with the ("agents", "action") that led to it; batch [b]."""
        agents, rows = observation["agents"], self._rows
        alive, grid = agents["alive"], maps_that_count(observation, self._shared)
        maps = snapshot(grid, self._target[rows], alive)
        entries = {key: agents[key] for key in (*STATES, *EVENTS)}
        entries["linked"] = any_linked(entries["linked"])
        # the reset has none
        stays = torch.full_like(alive, STAY, dtype=torch.int64)
        entries["action"] = agents["action"] if self._steps else stays
        self._steps.append(_Step(rows, maps, entries))
        self._now = _Now(grid, alive, agents["position"], maps.union_targets)
        if self._until_mapped:
            fewest = smallest_of_living(maps.known_targets, alive)
            over = (fewest == self._num_targets[rows]) | ~alive.any(-1)
            self._end((over & (self._ended[rows] < 0)).nonzero().squeeze(-1))

    def going_on(self) -> Tensor:
        """Places of the arenas, of the last observation's, whose episodes go on, int64 [any]."""
        return (self._ended[self._rows] < 0).nonzero().squeeze(-1)

    def only(self, places: Tensor) -> None:
        """From now on observations are of these arenas of the last one alone, int64 [b]."""
        self._rows = self._rows[places]
        self._now = _Now(*(entry[places] for entry in self._now))

    def _end(self, places: Tensor) -> None:
        """The episodes of some arenas of the last observation end with it."""
        if not len(places):
            return
        rows, now = self._rows[places], _Now(*(entry[places] for entry in self._now))
        target = self._target[rows]
        knowing = known_targets(known_mask(union_of(now.grid).unsqueeze(-3)), target).squeeze(-1)
        self._ended[rows] = len(self._steps) - 1
        self._lost[rows] = knowing - now.union_targets
        self._finishable[rows] = finishable(
            self._obstacles[rows], now.position, now.alive, now.grid, target
        )

    def episodes(self, horizon: int | None = None) -> Episodes:
        """All that was recorded.

        Args:
            horizon: steps T of an episode; None: as many as there were.
        """
        self._end(self.going_on())
        ended, horizon = self._ended, len(self._steps) - 1 if horizon is None else horizon
        times = torch.arange(horizon + 1, device=ended.device)
        last, during = torch.minimum(times, ended.unsqueeze(-1)), times <= ended.unsqueeze(-1)
        table = partial(_at, last)
        return Episodes(
            maps=Snapshot(*(table(self._counts(key)) for key in Snapshot._fields)),
            action=_at(last[:, 1:], self._entries("action")).where(during[:, 1:, None], STAY),
            num_targets=self._num_targets,
            ended=ended,
            finishable=self._finishable,
            lost_targets=self._lost,
            num_cells=self._config.num_cells,
            cell_size=self._config.cell_size,
            max_discovery=self._config.max_discovery,
            **{key: table(self._entries(key)) for key in STATES},
            **{key: table(self._entries(key)) * during.unsqueeze(-1) for key in EVENTS},
        )

    def _entries(self, key: str) -> Tensor:
        return self._table([step.entries[key] for step in self._steps])

    def _counts(self, key: str) -> Tensor:
        return self._table([getattr(step.maps, key) for step in self._steps])

    def _table(self, values: list[Tensor]) -> Tensor:
        """Values of all steps, [B, steps, ...]; 0 for arenas that were not observed any more."""
        first = values[0]
        table = first.new_zeros(len(first), len(values), *first.shape[1:])
        for number, (step, value) in enumerate(zip(self._steps, values, strict=True)):
            table[step.rows, number] = value
        return table


def maps_that_count(observation: TensorDictBase, shared: bool) -> Tensor:
    """The robots' maps [B, N, H, W]; for a reference that shares them, their union for each."""
    grid: Tensor = observation["agents", "map"]
    return union_of(grid).unsqueeze(-3).expand_as(grid) if shared else grid


def _at(times: Tensor, table: Tensor) -> Tensor:
    """The entries [B, T, ...] of a table [B, steps, ...] at times int64 [B, T]."""
    return table[torch.arange(len(table), device=table.device).unsqueeze(-1), times]
