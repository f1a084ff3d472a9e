"""What can keep a planner from its way in a wider world, each with a memory of its own.

Robots and people that no map shows, messages that get lost, and moves that have to wait for their
turn. Planners of worlds without them do not have these parts. What a part remembers is forgotten
where an episode begins.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import PATIENCE_STEPS
from marl_explore.config.shapes import Sight
from marl_explore.core.grid import (
    COMMUNICATE,
    FREE,
    OCCUPIED,
    flat_cell,
    other_robots,
)
from marl_explore.core.links import linked_others
from marl_explore.core.motion import has_to_give_way
from marl_explore.core.sensing import cells_seen_from
from marl_explore.core.sight import line_of_sight, shapes
from marl_explore.core.ways import has_to_make_room
from marl_explore.transforms import FrontierReachability
from marl_explore.transforms.memory import crowded_in

KEPT_STEPS = 32
"""How long a robot drives around something that it has seen once."""
ATTEMPTS = 3
"""Exchanges in a row that have to fail before a robot explores alone for a while."""
MOST_DOUBLINGS = 5


def begun(tensordict: TensorDictBase) -> Tensor:
    """Whether each team's episode begins, bool [*B, 1]."""
    return tensordict.get("step_count") == 0


class Obstructions:
    """Cells that hold something that is not on the map: a robot that failed, or people.

    Those are cells in the field of view that read 1 although the robot's own map has them free, and
    that hold no linked robot. A robot remembers them until it sees that they are free, or for
    ``KEPT_STEPS`` and as long again as it has known them: who stays will hardly go away.

    Args:
        sight: of the robots.
    """

    def __init__(self, sight: Sight) -> None:
        self.sight = sight
        self._since, self._until = torch.zeros(0), torch.zeros(0)

    def only(self, arenas: Tensor) -> None:
        """Forget all but some arenas of the batch, int64 [b], as for ``Planner.only``."""
        self._since, self._until = self._since[arenas], self._until[arenas]

    def maps(self, tensordict: TensorDictBase) -> Tensor:
        """The maps with those cells occupied, int8 [*B, N, H, W].

        A robot with frontiers to which it then has no path gets its map as it is: it goes there
        and waits.
        """
        agents = tensordict.get("agents")
        grid, position = agents.get("map"), agents.get("position")
        blocks = self._remember(tensordict, grid, position) & (grid == FREE)
        if not blocks.any():
            return grid
        around = grid.masked_fill(blocks, OCCUPIED)
        shut_in = _finds_frontiers(grid, position) & ~_finds_frontiers(around, position)
        return torch.where(shut_in[..., None, None], grid, around)

    def _remember(self, tensordict: TensorDictBase, grid: Tensor, position: Tensor) -> Tensor:
        """Cells that are remembered after one more observation, bool [*B, N, H, W]."""
        height, width = grid.shape[-2:]
        flat = grid.flatten(-2)
        if self._since.shape != flat.shape or self._since.device != grid.device:
            self._since = self._until = torch.zeros_like(flat, dtype=torch.int32)
        anew = begun(tensordict).unsqueeze(-1)
        now = tensordict.get("step_count").unsqueeze(-1).int() + 1  # 0 is never
        since, until = self._since.masked_fill(anew, 0), self._until.masked_fill(anew, 0)
        own = flat_cell(position, width)
        cell = cells_seen_from(height, width, self.sight.radius, grid.device)[own]
        fov = tensordict.get(("agents", "observation", "fov")).flatten(-2)
        empty = (fov == 0) | (cell == own.unsqueeze(-1)) | _held_by_mates(tensordict, cell)
        there = ~empty & (flat.gather(-1, cell) == FREE) & self._surely_seen(flat, cell)
        before = since.gather(-1, cell)
        first = torch.where(there & (before == 0), now, before)
        last = torch.where(there, 2 * now - first + KEPT_STEPS, until.gather(-1, cell))
        self._since = since.scatter(-1, cell, first.masked_fill_(empty, 0))
        self._until = until.scatter(-1, cell, last.masked_fill_(empty, 0))
        return (self._until > now).view(grid.shape)

    def _surely_seen(self, flat: Tensor, cell: Tensor) -> Tensor:
        """Which of the cells [*B, N, S] a robot sees for sure: unseen ones read 1 as well."""
        if self.sight.fills_windows:
            return torch.ones_like(cell, dtype=torch.bool)
        seen = shapes(self.sight, cell.device).flatten(-2)
        if self.sight.line_of_sight:
            side = self.sight.side
            # what it does not know may hide what is behind
            wall = (flat.gather(-1, cell) != FREE).unflatten(-1, (side, side))
            seen = seen & line_of_sight(wall).flatten(-2)
        return seen.expand_as(cell)


def _held_by_mates(tensordict: TensorDictBase, cell: Tensor) -> Tensor:
    """Which of the cells int64 [*B, N, S] hold linked robots."""
    agents = tensordict.get("agents")
    others, grid = linked_others(agents.get("linked")), agents.get("map")
    place = flat_cell(agents.get("position"), grid.shape[-1]).unsqueeze(-2).expand_as(others)
    held = torch.zeros_like(grid).flatten(-2).scatter_add_(-1, place, others.to(grid.dtype))
    return held.gather(-1, cell) > 0


def _finds_frontiers(grid: Tensor, position: Tensor) -> Tensor:
    """Whether robots have paths to frontiers, bool [*B, N]."""
    return (FrontierReachability(normalize=None).compute(grid, position)[..., 0] > 0).any(-1)


class LostMessages:
    """Robots whose exchanges fail again and again act as if alone for a while, then try again.

    Every further ``ATTEMPTS`` failures in a row double the time. Else robots that exchange maps
    until they have them would stand still forever where no message arrives.
    """

    def __init__(self) -> None:
        self._asked = torch.zeros(0, dtype=torch.bool)
        self._failures, self._until = torch.zeros(0), torch.zeros(0)

    def only(self, arenas: Tensor) -> None:
        """As ``Obstructions.only``."""
        self._asked, self._failures = self._asked[arenas], self._failures[arenas]
        self._until = self._until[arenas]

    def alone(self, tensordict: TensorDictBase) -> Tensor:
        """Robots that act as if they were not linked to any, bool [*B, N]."""
        merged, now = tensordict.get(("agents", "merged")), tensordict.get("step_count")
        if self._asked.shape != merged.shape or self._asked.device != merged.device:
            self._asked = torch.zeros_like(merged)
            self._failures = torch.zeros_like(merged, dtype=torch.int64)
            self._until = torch.zeros_like(self._failures)
        anew = merged | begun(tensordict)
        failed = self._asked & ~anew
        self._failures = (self._failures + failed).masked_fill_(anew, 0)
        doublings = (self._failures // ATTEMPTS - 1).clamp(0, MOST_DOUBLINGS)
        gives_up = failed & (self._failures % ATTEMPTS == 0)
        until = torch.where(gives_up, now + (PATIENCE_STEPS << doublings), self._until)
        self._until = until.masked_fill_(anew, 0)
        return self._until > now

    def note(self, action: Tensor) -> None:
        """Note what the robots do, int64 [*B, N]."""
        self._asked = action == COMMUNICATE


def without_links(agents: TensorDictBase, alone: Tensor) -> TensorDictBase:
    """The observation of a team in which some robots, bool [*B, N], know of no linked robot."""
    robots, mask = alone.shape[-1], agents.get("action_mask").clone()
    others = other_robots(robots, alone.device).bool()
    mask[..., COMMUNICATE] &= ~alone
    return (
        agents.copy()
        .set("linked", agents.get("linked") & ~(alone.unsqueeze(-1) & others))
        .set("action_mask", mask)
    )


class Turns:
    """Keeps a refusal until the robot may move again, if robots may not move at every step.

    Args:
        period: ``ArenaConfig.move_period``.
    """

    def __init__(self, period: int | tuple[int, ...]) -> None:
        self.period = period
        self._refused: Tensor | None = None
        """In the last step."""

    def only(self, arenas: Tensor) -> None:
        """As ``Obstructions.only``."""
        if self._refused is not None:
            self._refused = self._refused[arenas]

    def refused(self, tensordict: TensorDictBase) -> Tensor:
        """Robots that have to give way, bool [*B, N]; to be asked once per step."""
        refused, before = tensordict.get(("agents", "dangerous")), self._refused
        if before is not None and (before.shape, before.device) == (refused.shape, refused.device):
            refused = has_to_give_way(refused, before, self.period, tensordict.get("step_count"))
        self._refused = refused
        return refused


class Room:
    """Keeps in mind who was crowded until it has made room (``core.ways``)."""

    def __init__(self) -> None:
        self._crowded: Tensor | None = None
        """Who had to at the last step."""
        self._position = torch.zeros(0)

    def only(self, arenas: Tensor) -> None:
        """As ``Obstructions.only``."""
        if self._crowded is not None:
            self._crowded, self._position = self._crowded[arenas], self._position[arenas]

    def wanted(self, tensordict: TensorDictBase) -> Tensor:
        """Robots that have to make room, bool [*B, N]; to be asked once per step."""
        now, before = crowded_in(tensordict), self._crowded
        position = tensordict.get(("agents", "position"))
        if before is not None and (before.shape, before.device) == (now.shape, now.device):
            step = tensordict.get("step_count")
            grid = tensordict.get(("agents", "map"))
            now = has_to_make_room(now, before, grid, position, self._position, step)
        self._crowded, self._position = now, position
        return now


class Hindrances:
    """The parts that an arena makes necessary.

    Args:
        config: the arena; None: one without hindrances.
    """

    def __init__(self, config: ArenaConfig | None) -> None:
        self._obstructions: Obstructions | None = None
        self._messages: LostMessages | None = None
        self._turns: Turns | None = None
        self._room = Room()
        if config is None:
            return
        if config.failure_rate > 0 or config.num_walkers > 0:
            self._obstructions = Obstructions(config.sight)
        if config.message_loss > 0:
            self._messages = LostMessages()
        if config.move_period != 1:
            self._turns = Turns(config.move_period)

    def only(self, arenas: Tensor) -> None:
        """As ``Obstructions.only``."""
        for part in (self._obstructions, self._messages, self._turns, self._room):
            if part is not None:
                part.only(arenas)

    def seen(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The observation that plans are made on; to be asked once per step."""
        agents = tensordict.get("agents")
        if self._obstructions is not None:
            agents = agents.copy().set("map", self._obstructions.maps(tensordict))
        if self._messages is not None:
            agents = without_links(agents, self._messages.alone(tensordict))
        if agents is tensordict.get("agents"):
            return tensordict
        return tensordict.copy().set("agents", agents)

    def refused(self, tensordict: TensorDictBase) -> Tensor:
        """Robots that have to give way, bool [*B, N]; to be asked once per step."""
        if self._turns is None:
            return tensordict.get(("agents", "dangerous"))
        return self._turns.refused(tensordict)

    def crowded(self, tensordict: TensorDictBase) -> Tensor:
        """Robots that have to make room, bool [*B, N]; to be asked once per step."""
        return self._room.wanted(tensordict)

    def note(self, action: Tensor) -> None:
        """Note what the robots do, int64 [*B, N]."""
        if self._messages is not None:
            self._messages.note(action)
