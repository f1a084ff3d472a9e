"""From chosen goals to moves."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.constants import GOAL_COLUMNS, MATE_COLUMNS, MAX_FRONTIERS
from marl_explore.config.goals import PATIENCE
from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.core.motion import turns_back
from marl_explore.transforms.goals import Candidates
from marl_explore.transforms.memory import GOAL, HEADING, STALLED


def follow(tensordict: TensorDictBase, candidates: Candidates, choice: Tensor) -> Tensor:
    """The first move to each robot's choice, whose cell is written into the memory as its goal.

    Choices 0 to 23 are the candidate frontiers, the next N the teammates, then to communicate and
    to stay, which leave the goal as it is.

    Args:
        tensordict: with the memory (``transforms.memory.RememberTeam``).
        candidates: what there is to choose from.
        choice: int64 [*B, N].

    Returns:
        int64 [*B, N]; first moves need not be allowed.
    """
    place, last = candidates.frontiers[..., :2].long(), tensordict.get(GOAL)
    mates = torch.full_like(candidates.mates[..., :2], -1, dtype=torch.int64)
    last = last.unsqueeze(-2)
    goal = _pick(torch.cat((place, mates, last, last), -2), choice)
    tensordict.set(GOAL, goal)
    still = torch.tensor([COMMUNICATE, STAY], device=choice.device)
    move = torch.cat(
        (
            candidates.frontiers[..., GOAL_COLUMNS.index("move")],
            candidates.mates[..., MATE_COLUMNS.index("move")],
            still.expand(*choice.shape, -1),
        ),
        -1,
    )
    return _pick(move.unsqueeze(-1), choice).squeeze(-1).long()


def keep_goal(candidates: Candidates, choice: Tensor, stalled: Tensor) -> Tensor:
    """The choices of robots, some of which stay with the goal that they had.

    Those go to the candidate frontier nearest to their last goal, the first of several as near.
    Who communicates, or has no goal or no candidate, is not concerned.

    Args:
        candidates: what there is to choose from.
        choice: int64 [*B, N].
        stalled: who stays with its goal, bool [*B, N].
    """
    away = candidates.frontiers[..., GOAL_COLUMNS.index("from_last_goal")]
    there = (candidates.frontiers[..., GOAL_COLUMNS.index("moves")] > 0) & (away >= 0)
    first = torch.arange(MAX_FRONTIERS, device=choice.device)
    order = torch.where(there, away.long() * MAX_FRONTIERS + first, torch.iinfo(torch.int64).max)
    communicate, _ = still_choices(candidates.mates.shape[-2])
    keeps = stalled & there.any(-1) & (choice != communicate)
    return torch.where(keeps, order.argmin(-1), choice)


def goes_to_and_fro(tensordict: TensorDictBase, move: Tensor) -> Tensor:
    """Robots that turn back again though their maps have not grown for long, bool [*B, N].

    They have learned nothing on the way; two places can seem better in turns for ever. Such a robot
    has to give way (``core.motion.give_way``).

    Args:
        tensordict: with the memory.
        move: the wanted moves, int64 [*B, N].
    """
    return (tensordict.get(STALLED) > PATIENCE) & turns_back(move, tensordict.get(HEADING))


def still_choices(robots: int) -> tuple[int, int]:
    """The choices to communicate and to stay in a team of N robots."""
    return MAX_FRONTIERS + robots, MAX_FRONTIERS + robots + 1


def _pick(rows: Tensor, choice: Tensor) -> Tensor:
    """The chosen rows [*B, N, X] of [*B, N, choices, X]."""
    index = choice[..., None, None].expand(*choice.shape, 1, rows.shape[-1])
    return rows.gather(-2, index).squeeze(-2)
