"""The paper's two rewards, a variant of the second, and the team's (docs/environment.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.core.grid import COMMUNICATE, STAY, other_robots
from marl_explore.core.mapping import known_cells, known_mask, union_of
from marl_explore.core.survivors import largest_of_living, mean_of_living, some_failed


class StepRecord(NamedTuple):
    """What one step did, the argument of a reward; ``|M|``: known cells of a map."""

    action: Tensor
    """int64 [*B, N]."""
    dangerous: Tensor
    """Moves that were refused, bool [*B, N]."""
    network: Tensor
    """Pairs in one network, bool [*B, N, N], True on the diagonal for its members."""
    discovered: Tensor
    """New cells of the own map from own sensing, int64 [*B, N]."""
    received: Tensor
    """New cells of the own map from merging, int64 [*B, N]."""
    known: Tensor
    """``|M_i|`` after the step, int64 [*B, N]."""
    unshared: Tensor
    """q_ij before the step's merges reset it, int64 [*B, N, N] (cells)."""
    missing: Tensor
    """Target cells that each map does not know after the step, int64 [*B, N]."""
    alive: Tensor
    """Robots that have not failed, this step included, bool [*B, N]."""
    maps: tuple[Tensor, Tensor]
    """Maps before and after the step, int8 [*B, N, H, W] each."""
    num_cells: int
    """H x W."""
    max_discovery: int | Tensor
    """e_max, the most cells that one move can discover; of robots that differ int64 [N]."""

    @property
    def merged(self) -> Tensor:
        """Members of a network, bool [*B, N]."""
        return self.network.diagonal(dim1=-2, dim2=-1)

    @property
    def complete(self) -> Tensor:
        """Whether the map of some living robot is complete after the step, bool [*B]."""
        return ((self.missing == 0) & self.alive).any(-1)

    @property
    def gain(self) -> Tensor:
        """``|M_i^t| - |M_i^(t-1)|``, int64 [*B, N]."""
        return self.discovered + self.received

    @property
    def union_growth(self) -> Tensor:
        """Cells that were new to all living robots, int64 [*B]."""
        before, after = (known_cells(known_mask(union_of(grid, self.alive))) for grid in self.maps)
        return after - before


Reward = Callable[[StepRecord], Tensor]
"""From a step's record to each robot's own reward, float [*B, N]; the team's is their mean."""


def case1(step: StepRecord) -> Tensor:
    """-100 if dangerous, else the cells added to the own map (Eq. 2)."""
    return torch.where(step.dangerous, -100.0, step.gain.float())


def case2(step: StepRecord) -> Tensor:
    """-10 if dangerous, a share of a merge's gain, else discoveries minus idleness (Eq. 3)."""
    reward = _case2(step, idle=step.action == STAY)
    return reward.masked_fill_((step.action == COMMUNICATE) & ~step.merged, 0.0)


def case2_lone_idle(step: StepRecord) -> Tensor:
    """As ``case2``, but a robot that communicates alone shares no data and counts as idle."""
    return _case2(step, idle=(step.action == STAY) | (step.action == COMMUNICATE))


def _case2(step: StepRecord, idle: Tensor) -> Tensor:
    gain = step.gain.float()
    exploring = gain / step.max_discovery - idle.float()
    merged = step.merged
    sharing = _share_bonus(step) * gain / step.num_cells
    reward = torch.where(merged, sharing, exploring)
    return reward.masked_fill_(step.dangerous, -10.0)


def _share_bonus(step: StepRecord) -> Tensor:
    """p_i = 0.8 + mean over the other members j of q_ij / (H W), float [*B, N]."""
    partners = step.network * other_robots(step.network.shape[-1], step.network.device)
    shared = (step.unshared * partners).sum(-1)
    return 0.8 + shared / (step.num_cells * partners.sum(-1).clamp_min_(1))


def team(step: StepRecord) -> Tensor:
    """Growth of the largest map minus costs of time and refused moves; equal for all robots."""
    return _less_prices(_growth(step), step)


def progress(step: StepRecord) -> Tensor:
    """As ``team``, but with the mean of two growths: of the largest map and of the mean map.

    Discoveries of every robot count immediately, not only when they reach the largest map.
    """
    mean = mean_of_living(step.gain.float(), step.alive).unsqueeze(-1)
    return _less_prices((_growth(step) + mean) / 2, step)


def union(step: StepRecord) -> Tensor:
    """As ``team``, but with the mean of two growths: of the largest map and of all maps' union.

    A discovery counts immediately, and once. Until an arena is complete both grow by the same cells
    whatever the team does, so without a discount an episode's return depends on its time only.
    """
    return _less_prices((_growth(step) + step.union_growth.unsqueeze(-1)) / 2, step)


def _growth(step: StepRecord) -> Tensor:
    """Growth of the living robots' largest map, int64 [*B, 1] (cells)."""
    before, after = (
        largest_of_living(known, step.alive) for known in (step.known - step.gain, step.known)
    )
    return (after - before).unsqueeze(-1)


def _less_prices(growth: Tensor, step: StepRecord) -> Tensor:
    """Growth [*B, 1] (cells) as reward, minus costs of time and refused moves, float [*B, N]."""
    danger = mean_of_living(step.dangerous.float(), step.alive).unsqueeze(-1)
    unfinished = ~step.complete.unsqueeze(-1)
    return (growth / 40 - 0.1 * unfinished - 0.25 * danger).expand_as(step.dangerous)


REWARDS: dict[str, Reward] = {
    "case1": case1,
    "case2": case2,
    "case2-lone-idle": case2_lone_idle,
    "team": team,
    "progress": progress,
    "union": union,
}


def checked(reward: Tensor, step: StepRecord) -> Tensor:
    """The reward of the living robots, after checking that it is float [*B, N]; else 0.

    Raises:
        ValueError: naming its dtype and shape.
    """
    shape = step.action.shape
    if not reward.is_floating_point() or reward.shape != shape:
        raise ValueError(
            f"reward must return a float tensor of shape {tuple(shape)}, one number per robot, "
            f"got {reward.dtype} of shape {tuple(reward.shape)}"
        )
    if not some_failed(step.alive):
        return reward.float()
    return reward.float().masked_fill(~step.alive, 0.0)


def resolve(reward: str | Reward) -> Reward:
    """The reward with this name, or the callable itself.

    Raises:
        ValueError: naming the known rewards, for an unknown name.
    """
    if callable(reward):
        return reward
    if reward not in REWARDS:
        raise ValueError(
            f"reward={reward!r} is unknown: use a callable or one of {sorted(REWARDS)}"
        )
    return REWARDS[reward]
