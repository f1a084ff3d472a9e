"""Candidate goals of each robot as parts of its observation."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from marl_explore.config.constants import (
    COMMUNICATE,
    CONTEXT_COLUMNS,
    GOAL_COLUMNS,
    LONG_AGO,
    MATE_COLUMNS,
    MAX_FRONTIERS,
)
from marl_explore.config.shapes import Sight
from marl_explore.core import goals
from marl_explore.core.goals import GoalTable, Situation, taken_cells
from marl_explore.core.grid import NUM_DIRECTIONS, other_robots
from marl_explore.core.links import linked_others
from marl_explore.core.mapping import known_cells, known_mask
from marl_explore.core.memory import TeamMemory
from marl_explore.core.native import Backend
from marl_explore.core.native import goals as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.transforms.memory import ALL_COVERED, MEMORY, REFUSED, from_tensordict

READ: list[NestedKey] = [
    "step_count",
    *(
        ("agents", key)
        for key in (
            "map",
            "position",
            "linked",
            "unshared",
            "steps_since_merge",
            "action_mask",
        )
    ),
    ("agents", "observation", "fov"),
]


class Candidates(NamedTuple):
    """What each robot can choose from, int32: parts of the observation of these names."""

    frontiers: Tensor
    """[*B, N, 24, 14], ``GoalTable.frontiers``."""
    rivals: Tensor
    """[*B, N, 24, N, 2], ``GoalTable.rivals``."""
    mates: Tensor
    """[*B, N, N, 9]: about every teammate, the columns ``MATE_COLUMNS``; 0 for itself."""
    context: Tensor
    """[*B, N, 9], the columns ``CONTEXT_COLUMNS``."""


def find_candidates(
    tensordict: TensorDictBase, sight: Sight, backend: Backend = "auto"
) -> Candidates:
    """The candidates of every robot, from an environment's step and the robots' memory.

    It notes in the memory whether all frontiers that a robot can reach are covered.

    Args:
        tensordict: with the entries ``READ`` and the memory (``RememberTeam``), any batch
            dimensions.
        sight: of the robots.
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible). The
            results are identical.
    """
    agents, memory = tensordict.get("agents"), from_tensordict(tensordict.get(MEMORY))
    grid, position, mask = (agents.get(key) for key in ("map", "position", "action_mask"))
    fov = agents.get(("observation", "fov"))
    situation = Situation(
        grid, position, taken_cells(fov, grid, position, sight), mask[..., :NUM_DIRECTIONS], memory
    )
    c_code = in_use("goals", backend, grid.device)
    table = (kernel if c_code else goals).goal_table(situation, sight)
    tensordict.set(ALL_COVERED, table.all_covered)
    now = tensordict.get("step_count")
    return Candidates(
        table.frontiers,
        table.rivals,
        _mates(agents, now, memory, table),
        _context(tensordict, table, sight),
    )


def _mates(agents: TensorDictBase, now: Tensor, memory: TeamMemory, table: GoalTable) -> Tensor:
    """``Candidates.mates``."""
    position = agents.get("position")
    linked = linked_others(agents.get("linked"))
    others = other_robots(position.shape[-2], position.device)
    seen = memory.seen.step >= 0
    apart = (position.unsqueeze(-3) - position.unsqueeze(-2)).square().sum(-1)
    columns = (
        seen,
        linked,
        (now.unsqueeze(-1) - memory.seen.step) * seen,
        *table.ways.unbind(-1),
        agents.get("unshared") * others,
        agents.get("steps_since_merge").clamp_max(LONG_AGO) * others,
        apart * linked,
        memory.seen.waited,
    )
    return torch.stack([column.int() for column in columns], -1)


def _context(tensordict: TensorDictBase, table: GoalTable, sight: Sight) -> Tensor:
    """``Candidates.context``."""
    agents = tensordict.get("agents")
    grid = agents.get("map")
    *_, robots, height, width = grid.shape
    known = known_cells(known_mask(grid))
    columns = (
        tensordict.get("step_count").expand_as(known),
        known,
        torch.full_like(known, height * width),
        torch.full_like(known, robots),
        table.all_covered,
        tensordict.get(REFUSED),
        agents.get("action_mask")[..., COMMUNICATE],
        *(entry.expand_as(known) for entry in _sensors(sight, grid.device)),
    )
    return torch.stack([column.int() for column in columns], -1)


@lru_cache
def _sensors(sight: Sight, device: torch.device) -> tuple[Tensor, Tensor]:
    """k of each robot, and the cells in its shape, int32 [N], or [1] if all are equal."""
    radii, sizes = (
        torch.tensor(x, dtype=torch.int32, device=device) for x in (sight.radii, sight.sizes)
    )
    return radii, sizes


class GoalCandidates(Transform):
    """Writes the candidate goals of every robot (docs/goals.md), from the memory in the TensorDict.

    The entries are ("agents", "observation", name) for the names of ``Candidates``. It needs
    ``RememberTeam`` before it.

    Args:
        backend: as for ``find_candidates``.
        sight: of the robots (``ArenaConfig.sight``); None: they see their whole field of view.
    """

    def __init__(self, backend: Backend = "auto", sight: Sight | None = None) -> None:
        outputs: list[NestedKey] = [("agents", "observation", name) for name in Candidates._fields]
        super().__init__(in_keys=[*READ, MEMORY], out_keys=outputs)
        self.backend: Backend = backend
        self.sight = sight

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        radius = next_tensordict.get(("agents", "observation", "fov")).shape[-1] // 2
        found = find_candidates(next_tensordict, self.sight or Sight.square(radius), self.backend)
        for key, entry in zip(self.out_keys, found, strict=True):
            next_tensordict.set(key, entry)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the candidates into a TensorDict."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the candidates to the observation spec."""
        maps = observation_spec["agents", "map"]
        team, robots = maps.shape[:-2], maps.shape[-3]
        shapes = (
            (MAX_FRONTIERS, len(GOAL_COLUMNS)),
            (MAX_FRONTIERS, robots, 2),
            (robots, len(MATE_COLUMNS)),
            (len(CONTEXT_COLUMNS),),
        )
        for key, shape in zip(self.out_keys, shapes, strict=True):
            observation_spec[key] = Unbounded(
                shape=(*team, *shape), dtype=torch.int32, device=maps.device
            )
        return observation_spec
