"""Which entries of a batch belong to which actor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor

View = tuple[NestedKey, int | tuple[int, ...]]
"""A group and the index of an agent in it, or those of several agents that share an actor."""


def agents_of(view: View) -> tuple[int, ...]:
    """The indices of a view's agents in their group."""
    return view[1] if isinstance(view[1], tuple) else (view[1],)


def views_of(names: Iterable[str], group_map: Mapping[str, Sequence[str]]) -> dict[str, View]:
    """The views of actors that are named after the agents or groups of an environment.

    An actor with the name of an agent acts for this agent, also in a group of its own
    (``MarlGroupMapType.ONE_GROUP_PER_AGENT``). One with the name of a group acts for the whole
    group and has no view.

    Args:
        names: of the actors.
        group_map: an environment's ``group_map``: per group its agents, in the order of the
            agents' axis.

    Raises:
        ValueError: for a name that is neither an agent's nor a group's.
    """
    agents = {
        agent: (group, index)
        for group, members in group_map.items()
        for index, agent in enumerate(members)
    }
    unknown = [name for name in names if name not in agents and name not in group_map]
    if unknown:
        raise ValueError(
            f"actors {unknown} are not in group_map: its groups are {list(group_map)}, its agents "
            f"{list(agents)}"
        )
    return {name: agents[name] for name in names if name in agents}


def find_views(
    names: Iterable[str],
    views: Mapping[str, View] | None,
    group_map: Mapping[str, Sequence[str]] | None,
) -> dict[str, View]:
    """The views that were given, or those of a group map.

    Raises:
        ValueError: when both are given, and as ``views_of``.
    """
    if group_map is None:
        return dict(views or {})
    if views is not None:
        raise ValueError("views and group_map say the same: give one of them")
    return views_of(names, group_map)


@cache
def in_group(key: NestedKey, group: NestedKey) -> bool:
    """Whether an entry belongs to a group."""
    path, prefix = (k if isinstance(k, tuple) else (k,) for k in map(unravel_key, (key, group)))
    return path[: len(prefix)] == prefix


def slice_agent(
    batch: TensorDictBase, entries: Mapping[NestedKey, Tensor], view: View, name: str
) -> TensorDictBase:
    """The entries of a view: slices of its group's [*B, N, ...]; others are not sliced.

    One agent's are [*B, ...], those of a tuple of k agents [*B, k, ...].

    Raises:
        ValueError: when the group's entries do not all have an agents' axis that holds the index.
    """
    group, index = view
    axis = batch.ndim
    grouped = {key: entry for key, entry in entries.items() if in_group(key, group)}
    sizes = {entry.shape[axis : axis + 1] for entry in grouped.values()}
    agents = sizes.pop() if len(sizes) == 1 else ()
    last = max(agents_of(view))
    if not agents or last >= agents[0]:
        shapes = ", ".join(f"{key!r} {[*entry.shape]}" for key, entry in grouped.items())
        raise ValueError(
            f"views[{name!r}]={view!r} does not fit the batch of shape {[*batch.batch_size]}: the "
            f"axis after those of the batch must be that of the agents, more than {last} of them, "
            f"in every entry of {group!r}; they are {shapes}"
        )
    own = TensorDict({}, batch_size=batch.batch_size, device=batch.device)
    for key, value in entries.items():
        own.set(key, _slice(value, axis, index) if key in grouped else value)
    return own


def _slice(entry: Tensor, axis: int, index: int | tuple[int, ...]) -> Tensor:
    if isinstance(index, int):
        return entry.select(axis, index)
    return entry.index_select(axis, torch.tensor(index, device=entry.device))
