"""Every implementation of the goal table, called as one, and random teams in the oracle's words."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight
from marl_explore.core import goals, native
from marl_explore.core.goals import GoalTable, Situation
from marl_explore.core.memory import NOT_SEEN, Observation, Sightings, TeamMemory
from marl_explore.core.native import goals as kernel
from tests.helpers import goal_oracle, world_oracle

NAMED = {} if native.missing("goals") else {"native": kernel.goal_table}
"""Functions of a situation and the team's sight that have to give the same as ``core.goals``."""


def goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """``core.goals.goal_table``, once all others have been held against it."""
    table = goals.goal_table(situation, sight)
    for name, implementation in NAMED.items():
        other = implementation(situation, sight)
        for entry, tensor in table._asdict().items():
            assert getattr(other, entry).dtype == tensor.dtype, (name, entry)
            assert getattr(other, entry).equal(tensor), (name, entry)
    return table


def sensors(sight: Sight, robots: int) -> world_oracle.Settings:
    """The sight of a team in the oracle's words; its cells are metres."""
    return world_oracle.Settings(
        num_agents=robots,
        cell_size=1.0,
        sensing_range=tuple(sight.of(robot).ranges_cells[0] for robot in range(robots)),
        sensing_shape=sight.shape,
        line_of_sight=sight.line_of_sight,
    )


def robot_memory(memory: TeamMemory, arena: int, robot: int) -> goal_oracle.Memory:
    """What one robot remembers, as the oracle writes it down."""
    steps = memory.seen.step[arena, robot].tolist()
    seen = zip(steps, memory.seen.cell[arena, robot].tolist(), strict=True)
    return goal_oracle.Memory(
        seen_step=steps,
        seen_cell=[None if step == NOT_SEEN else tuple(cell) for step, cell in seen],
        waited=memory.seen.waited[arena, robot].tolist(),
        known_by=[_cells(mask) for mask in memory.known_by[arena, robot]],
        covered=_cells(memory.covered[arena, robot]),
        stuck=memory.stuck[arena, robot].item(),
        known=memory.known[arena, robot].item(),
        stalled=memory.stalled[arena, robot].item(),
        position=tuple(memory.position[arena, robot].tolist()),
        heading=memory.heading[arena, robot].item(),
        goal=tuple(memory.goal[arena, robot].tolist()),
    )


def next_robot_memory(
    before: goal_oracle.Memory,
    observed: Observation,
    arena: int,
    robot: int,
    all_covered: bool,
    sight: Sight,
    patience: int = goal_oracle.PATIENCE,
) -> goal_oracle.Memory:
    """The oracle's memory of one robot after an observation of its team."""
    cells = [tuple(cell) for cell in observed.position[arena].tolist()]
    linked = observed.linked[arena, robot].tolist()
    since = observed.since[arena, robot].tolist()
    others = [j for j in range(len(cells)) if j != robot]
    return goal_oracle.remember(
        before,
        observed.now[arena].item(),
        observed.grid[arena, robot].tolist(),
        cells[robot],
        {j: cells[j] for j in others if linked[j]},
        [j for j in others if since[j] == 0],
        all_covered,
        sensors(sight, len(cells)),
        patience,
    )


def robot_table(
    situation: Situation, memory: goal_oracle.Memory, arena: int, robot: int, sight: Sight
) -> dict:
    """The oracle's goal table of one robot in a situation; the memory is given apart."""
    position = tuple(situation.position[arena, robot].tolist())
    taken = situation.taken[arena, robot].tolist()
    return goal_oracle.goal_table(
        robot,
        situation.grid[arena, robot].tolist(),
        position,
        {goal_oracle.neighbour(position, d) for d in range(8) if taken[d]},
        situation.allowed[arena, robot].tolist(),
        memory,
        sensors(sight, len(memory.seen_step)),
    )


def of_robot(table: GoalTable, arena: int, robot: int) -> dict:
    """The package's goal table of one robot as the oracle writes it down."""
    return {name: tensor[arena, robot].tolist() for name, tensor in table._asdict().items()}


class Chance:
    """Random tensors that a seed determines."""

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)

    def integers(self, low: int, high: int, *shape: int) -> Tensor:
        """Int64 from low to high, both included."""
        return torch.randint(low, high + 1, shape, generator=self.generator)

    def flags(self, share: float, *shape: int) -> Tensor:
        """Bool, True with a probability."""
        return torch.rand(shape, generator=self.generator) < share

    def cells(self, height: int, width: int, *shape: int) -> Tensor:
        """Cells of an arena, int64 [*shape, 2]."""
        rows, columns = self.integers(0, height - 1, *shape), self.integers(0, width - 1, *shape)
        return torch.stack((rows, columns), -1)

    def patches(self, height: int, width: int, *shape: int) -> Tensor:
        """Sets of cells, bool [*shape, H, W]: squares of any share of the arena, and noise."""
        share = torch.rand(shape, generator=self.generator).pow(2)[..., None, None]
        coarse = torch.rand((*shape, -(-height // 3), -(-width // 3)), generator=self.generator)
        fine = coarse.repeat_interleave(3, -2).repeat_interleave(3, -1)[..., :height, :width]
        noise = torch.rand(fine.shape, generator=self.generator) < 0.05
        return (fine < share) ^ noise

    def memory(self, position: Tensor, height: int, width: int, now: int = 20) -> TeamMemory:
        """Any memory of robots at positions [B, N, 2] before a step of the episode."""
        teams, robots, _ = position.shape
        pairs = (teams, robots, robots)
        never = self.flags(0.3, *pairs) | torch.eye(robots).bool()
        recent = torch.where(self.flags(0.5, *pairs), now - 1, self.integers(0, now - 1, *pairs))
        seen = Sightings(
            step=recent.masked_fill(never, NOT_SEEN),
            cell=self.cells(height, width, *pairs),
            waited=self.flags(0.3, *pairs),
        )
        goal = self.cells(height, width, teams, robots)
        goal[self.flags(0.2, teams, robots)] = -1
        return TeamMemory(
            seen=seen,
            known_by=self.patches(height, width, *pairs),
            covered=self.patches(height, width, teams, robots),
            stuck=self.integers(0, 7, teams, robots),
            known=self.integers(0, height * width, teams, robots),
            stalled=self.integers(0, 60, teams, robots),
            position=position,
            heading=self.integers(-1, 7, teams, robots),
            goal=goal,
        )


def _cells(mask) -> set[tuple[int, int]]:
    return {tuple(cell) for cell in mask.nonzero().tolist()}
