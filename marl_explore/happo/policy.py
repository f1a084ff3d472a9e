"""A team's actors as one policy, so that a collector can run them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from marl_explore.happo.views import View, agents_of, in_group, slice_agent


class TeamPolicy(TensorDictModuleBase):
    """Actors that each act for an agent of a stacked group, for several, or for a whole group.

    Every actor reads its slice of the group's entries [*B, N, ...], [*B, ...] or, for k agents,
    [*B, k, ...]; what it writes into the group, and under "next" into the group (the states of
    recurrent actors), is stacked again.
    It calls one actor after the other: for networks of the same kind, one call over stacked
    parameters is faster.

    Args:
        actors: by name, as for ``HAPPOLoss``.
        views: per actor its group and index in it; none for actors of whole groups.

    Raises:
        ValueError: when a group's actors do not have the indices 0 ... k - 1 together, each once;
            when called, if the group has other than k agents.
    """

    def __init__(self, actors: Mapping[str, nn.Module], views: Mapping[str, View]) -> None:
        super().__init__()
        self.actors: Mapping[str, Any] = nn.ModuleDict(actors)  # type: ignore[assignment]
        self.views = dict(views)
        self.groups: dict[NestedKey, list[str]] = {}
        for name in sorted(self.views, key=lambda name: agents_of(self.views[name])):
            self.groups.setdefault(unravel_key(self.views[name][0]), []).append(name)
        self._places: dict[NestedKey, list[int]] = {}  # of each agent in the rows of all actors
        for group, names in self.groups.items():
            indices = [index for name in names for index in agents_of(self.views[name])]
            self._places[group] = sorted(range(len(indices)), key=indices.__getitem__)
            if sorted(indices) != [*range(len(indices))]:
                raise ValueError(
                    f"a policy needs an actor for every agent of the group {group!r}: those with "
                    f"views, {names}, have the indices {indices}"
                )
        actors_keys = [(a.in_keys, self._written(name)) for name, a in self.actors.items()]
        self.in_keys = [*dict.fromkeys(key for keys, _ in actors_keys for key in keys)]
        self.out_keys = [*dict.fromkeys(key for _, keys in actors_keys for key in keys)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions of all agents, their log-probabilities and the actors' states."""
        for name, actor in self.actors.items():
            if name not in self.views:
                actor(tensordict)
        axis = tensordict.ndim
        for group, names in self.groups.items():
            rows: dict[NestedKey, list[Tensor]] = {}
            places = self._places[group]
            for name in names:
                entries = {key: tensordict.get(key) for key in self.actors[name].in_keys}
                for key, entry in entries.items():
                    if in_group(key, group) and entry.shape[axis] != len(places):
                        raise ValueError(
                            f"{key!r} has shape {[*entry.shape]}, but the group {group!r} has "
                            f"actors for {len(places)} agents"
                        )
                own = slice_agent(tensordict, entries, self.views[name], name)
                written = self.actors[name](own)
                single = not isinstance(self.views[name][1], tuple)
                for key in self._written(name):
                    entry = written.get(key)
                    rows.setdefault(key, []).append(entry.unsqueeze(axis) if single else entry)
            for key, row in rows.items():
                together = torch.cat(row, axis)
                if places != [*range(len(places))]:
                    order = torch.tensor(places, device=together.device)
                    together = together.index_select(axis, order)
                tensordict.set(key, together)
        return tensordict

    def _written(self, name: str) -> list[NestedKey]:
        """The entries of an actor that leave it: with a view, those of its group."""
        keys = [unravel_key(key) for key in self.actors[name].out_keys]
        if name not in self.views:
            return keys
        group = self.views[name][0]
        return [k for k in keys if in_group(k[1:] if k[0] == "next" else k, group)]
