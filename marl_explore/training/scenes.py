"""Rollouts of several kinds of arenas and sizes of teams, as one batch for one policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_explore.planners.goal_moves import still_choices
from marl_explore.policies.actors import CHOICE, CHOICE_LOG_PROB
from marl_explore.training.restarts import RestartingCollector

_TEAM_DIMS = {"frontiers": (-3,), "rivals": (-4, -2), "mates": (-3, -2), "context": (-2,)}
"""Dimensions of candidates [*B, N, ...] that have an entry per robot of the team."""
_OF_STEP = ("reward", "done", "terminated")


class SceneRollouts:
    """A collector per scene; a batch is a list with a rollout [B, T] of each.

    Args:
        collectors: in the order of the scenes.
    """

    def __init__(self, collectors: Sequence[RestartingCollector]) -> None:
        self.collectors = [*collectors]

    def next(self) -> list[TensorDictBase]:
        """The next rollouts."""
        for collector in self.collectors:
            collector.prepare()
        return [collector.next() for collector in self.collectors]

    def state(self) -> list[Any]:
        """What the next rollouts depend on, for every worker of every scene."""
        return [state for collector in self.collectors for state in collector.state()]

    def load(self, states: Sequence[Any], done: int) -> None:
        """Resume from a ``state``; see ``RestartingCollector.load``."""
        share = len(states) // len(self.collectors)
        for number, collector in enumerate(self.collectors):
            collector.load([*states[number * share : (number + 1) * share]], done)

    def close(self) -> None:
        """Stop all workers."""
        for collector in self.collectors:
            collector.close()


def join_scenes(rollouts: Sequence[TensorDictBase]) -> TensorDictBase:
    """One batch from rollouts [B, T] of teams that choose among goals, padded to the largest team.

    A robot that is padding has no candidates, so it stays with probability 1: it changes no ratio,
    no entropy and no gradient.
    """
    if len(rollouts) == 1:
        return rollouts[0]
    robots = max(rollout[CHOICE].shape[-1] for rollout in rollouts)
    return torch.cat([_padded(rollout, robots) for rollout in rollouts])


def _padded(rollout: TensorDictBase, robots: int) -> TensorDictBase:
    """The entries that learning reads, for a larger team."""
    team = rollout[CHOICE].shape[-1]
    missing = robots - team
    # to communicate and to stay come after the teammates
    choice, (talk, _), (_, stay) = rollout[CHOICE], still_choices(team), still_choices(robots)
    choice = torch.where(choice >= talk, choice + missing, choice)
    following = rollout["next"]
    return TensorDict(
        {
            "agents": {
                "observation": _observation(rollout, missing),
                CHOICE[1]: torch.nn.functional.pad(choice, (0, missing), value=stay),
                CHOICE_LOG_PROB[1]: _pad(rollout[CHOICE_LOG_PROB], (-1,), missing),
            },
            "next": {
                "agents": {"observation": _observation(following, missing)},
                **{key: following[key] for key in _OF_STEP},
            },
        },
        batch_size=rollout.batch_size,
    )


def _observation(step: TensorDictBase, missing: int) -> dict[str, Tensor]:
    found = step["agents", "observation"]
    return {name: _pad(found[name], dims, missing) for name, dims in _TEAM_DIMS.items()}


def _pad(entry: Tensor, dims: Sequence[int], missing: int) -> Tensor:
    """Zeros after the last robot, in some dimensions counted from the end."""
    widths = [0] * (2 * -min(dims))
    for dim in dims:
        widths[2 * -dim - 1] = missing
    return torch.nn.functional.pad(entry, widths)
