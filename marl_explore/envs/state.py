"""The state of a batch of episodes: the worlds, and the effects of the last step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.core.world import WorldState


class LastStep(NamedTuple):
    """Effects of the last step on each robot [B, N]; at reset False or 0, except ``discovered``."""

    dangerous: Tensor
    merged: Tensor
    discovered: Tensor
    received: Tensor
    individual_reward: Tensor


class EpisodeState(NamedTuple):
    """Everything that the next observation and the future depend on, for B arenas."""

    world: WorldState
    last: LastStep

    @classmethod
    def at_rest(cls, world: WorldState, first: bool) -> EpisodeState:
        """A state before any step; at the ``first`` sensing the known cells are discoveries."""
        nothing = torch.zeros_like(world.known)
        last = LastStep(
            dangerous=nothing.bool(),
            merged=nothing.bool(),
            discovered=world.known if first else nothing,
            received=nothing.clone(),
            individual_reward=nothing.float().unsqueeze(-1),
        )
        return cls(world, last)

    @staticmethod
    def names() -> tuple[str, ...]:
        """Names of all tensors."""
        return (*WorldState._fields, *LastStep._fields)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> EpisodeState:
        """The inverse of ``tensors``."""
        world = WorldState(*(tensors[name] for name in WorldState._fields))
        return cls(world, LastStep(*(tensors[name] for name in LastStep._fields)))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {**self.world._asdict(), **self.last._asdict()}

    def apply(self, function: Callable[[Tensor], Tensor]) -> EpisodeState:
        """The state with ``function`` applied to every tensor."""
        return self.from_tensors({name: function(x) for name, x in self.tensors().items()})

    def replace_rows(self, rows: Tensor, fresh: EpisodeState) -> EpisodeState:
        """Copies of the tensors, with the arenas at indices ``rows`` [A] replaced by ``fresh``."""
        new = fresh.tensors()
        return self.from_tensors(
            {name: old.index_put((rows,), new[name]) for name, old in self.tensors().items()}
        )
