"""Measures of exploration episodes: what is recorded of each step, and the measures of it.

``docs/metrics.md`` has every formula. B is the number of episodes, T of steps, N of robots.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS
from marl_explore.core.mapping import cells_of_share, known_cells, known_mask, known_targets
from marl_explore.core.survivors import largest_of_living, mean_of_living, smallest_of_living

THRESHOLDS = (0.80, 0.90, 0.95, 0.99, 1.00)
"""Coverages for which the first step that reaches them is reported."""
CELLS_PER_BYTE = 4
"""Of a map that is sent: a cell is unknown, free or occupied."""
COVERAGE_STEPS = (20, 50, 150)
"""Steps at which coverage is reported, in addition to the last."""


class Snapshot(NamedTuple):
    """Counts of the maps at one time; a leading or second time axis may be added."""

    known_targets: Tensor
    """Target cells that each robot knows, int64 [B, N]."""
    union_targets: Tensor
    """Target cells that some living robot knows, int64 [B]."""
    known_cells: Tensor
    """``|M_i|``, int64 [B, N]."""
    union_cells: Tensor
    """Cells that some robot knows, int64 [B]."""


def snapshot(grid: Tensor, target: Tensor, alive: Tensor | None = None) -> Snapshot:
    """Count known cells and known target cells bool [B, H, W] of maps int8 [B, N, H, W].

    Args:
        grid: maps of all robots.
        target: the cells that are to be mapped.
        alive: robots that have not failed, bool [B, N]; None: all.
    """
    known = known_mask(grid)
    union = known.amax(-3, keepdim=True)
    living = union if alive is None else (known * alive[..., None, None]).amax(-3, keepdim=True)
    return Snapshot(
        known_targets=known_targets(known, target),
        union_targets=known_targets(living, target).squeeze(-1),
        known_cells=known_cells(known),
        union_cells=known_cells(union).squeeze(-1),
    )


class Episodes(NamedTuple):
    """Recorded episodes; step 0 of every entry except ``action`` is the reset."""

    maps: Snapshot
    """Counts with a time axis after B: [B, T + 1, N] or [B, T + 1]."""
    position: Tensor
    """(row, column), int64 [B, T + 1, N, 2]."""
    action: Tensor
    """int64 [B, T, N]."""
    dangerous: Tensor
    """bool [B, T + 1, N]."""
    merged: Tensor
    """bool [B, T + 1, N]."""
    discovered: Tensor
    """Own discoveries of each step, int64 [B, T + 1, N] (cells)."""
    received: Tensor
    """Cells that a merge added to each map, int64 [B, T + 1, N]."""
    linked: Tensor
    """Whether each robot is linked to another one, bool [B, T + 1, N]."""
    num_targets: Tensor
    """int64 [B]."""
    ended: Tensor
    """Steps until the end of each episode, int64 [B]: T, or fewer if it ended when the maps of all
    living robots were complete, or none lived. After it states stay and nothing happens."""
    finishable: Tensor
    """Whether the living robots can still complete a map after the last step, bool [B]."""
    lost_targets: Tensor
    """Target cells that only robots that failed know after the last step, int64 [B]."""
    num_cells: int
    """H x W."""
    cell_size: float
    """D (metres)."""
    alive: Tensor
    """Robots that have not failed, bool [B, T + 1, N]."""
    max_discovery: int | tuple[int, ...]
    """e_max; one per robot if they differ."""

    def cpu(self) -> Episodes:
        """The same with all tensors on the CPU."""
        moved: dict[str, Any] = {
            name: entry.cpu() for name, entry in self._asdict().items() if isinstance(entry, Tensor)
        }
        return self._replace(maps=Snapshot(*(entry.cpu() for entry in self.maps)), **moved)

    @property
    def horizon(self) -> int:
        """Steps T of every episode."""
        return self.action.shape[1]

    @property
    def during(self) -> Tensor:
        """Steps before the end of the episode, bool [B, T]."""
        return torch.arange(self.horizon, device=self.ended.device) < self.ended.unsqueeze(-1)

    @property
    def acting(self) -> Tensor:
        """Robots that were alive when they chose an action, bool [B, T, N]."""
        return self.alive[:, :-1] & self.during.unsqueeze(-1)


def coverage(episodes: Episodes) -> dict[str, Tensor]:
    """Shares of the target cells that are known, float64 [B, T + 1] each.

    "largest", "mean" and "smallest" over the maps of robots that have not failed, and "merged" for
    their union; 0 without any.
    """
    targets = episodes.num_targets[:, None]
    own, alive = episodes.maps.known_targets / targets.unsqueeze(-1).double(), episodes.alive
    return {
        "largest": largest_of_living(own, alive),
        "merged": episodes.maps.union_targets / targets.double(),
        "mean": mean_of_living(own, alive),
        "smallest": smallest_of_living(own, alive),
    }


def known_ratio(episodes: Episodes) -> Tensor:
    """The paper's ratio: cells of the largest map over H W, float64 [B, T + 1]."""
    largest = largest_of_living(episodes.maps.known_cells, episodes.alive)
    return largest.double() / episodes.num_cells


def steps_to(known: Tensor, targets: Tensor, share: float) -> Tensor:
    """First step at which a share of the target cells is known, int64 [B]; T + 1 if never.

    Args:
        known: known target cells, int64 [B, T + 1].
        targets: target cells, int64 [B].
        share: in (0, 1]; whole cells are compared.
    """
    reached = known >= cells_of_share(share, targets).unsqueeze(-1)
    first = reached.to(torch.uint8).argmax(-1)
    return torch.where(reached.any(-1), first, known.shape[-1])


def before_completion(episodes: Episodes) -> Tensor:
    """Steps taken while no map was complete, bool [B, T]."""
    known = largest_of_living(episodes.maps.known_targets, episodes.alive)[:, :-1]
    return known < episodes.num_targets.unsqueeze(-1)


class Share(NamedTuple):
    """A kind of event as a share of all events, counted per episode."""

    part: Tensor
    """int64 [B]."""
    whole: Tensor
    """int64 [B]."""

    @property
    def each(self) -> Tensor:
        """The share in every episode, float64 [B]; NaN where there were no events."""
        return self.part.double() / self.whole

    @property
    def pooled(self) -> float:
        """The share among the events of all episodes; NaN if there were none."""
        return float(self.part.sum().double() / self.whole.sum())


def communication_share(episodes: Episodes, steps: Tensor | None = None) -> Share:
    """Communicate actions over all actions, of robots that have not failed.

    Args:
        episodes: B episodes.
        steps: bool [B, T], the steps to count; None: all.
    """
    return _share(episodes.action == COMMUNICATE, episodes.acting, steps)


def useful_share(episodes: Episodes, steps: Tensor | None = None) -> Share:
    """Communicate actions that enlarged the sender's map over all, including lone ones."""
    communicating = (episodes.action == COMMUNICATE) & episodes.acting
    return _share(episodes.received[:, 1:] > 0, communicating, steps)


def dangerous_share(episodes: Episodes) -> Share:
    """Refused moves over chosen moves."""
    moves = (episodes.action < NUM_DIRECTIONS) & episodes.acting
    return _share(episodes.dangerous[:, 1:], moves)


def enlarging_share(episodes: Episodes) -> Share:
    """Enlargements of at least one cell over all enlargements, including those of 0 cells."""
    return _share(episodes.received > 0, episodes.merged)


def large_enlargement_share(episodes: Episodes) -> Share:
    """Enlargements of more than e_max cells over those of at least one."""
    most = torch.tensor(episodes.max_discovery, device=episodes.received.device)
    return _share(episodes.received > most, episodes.received > 0)


def unlinked_share(episodes: Episodes) -> Share:
    """Steps of living robots without any link over all of their steps."""
    alive = episodes.alive[:, 1:] & episodes.during.unsqueeze(-1)
    return _share(alive & ~episodes.linked[:, 1:], alive)


def _share(part: Tensor, whole: Tensor, steps: Tensor | None = None) -> Share:
    """The share of the events ``whole`` bool [B, T, N] that ``part`` has, at the steps to count."""
    if steps is not None:
        whole = whole & steps.unsqueeze(-1)
    return Share((part & whole).flatten(1).sum(-1), whole.flatten(1).sum(-1))


def enlargements(episodes: Episodes) -> Tensor:
    """Cells that each merge added to each member's map, including zeros, int64 [any]."""
    return episodes.received[episodes.merged]


def cells_sent(episodes: Episodes) -> Tensor:
    """``|M_i|`` summed over every member of every merge so far, int64 [B, T + 1] (cells)."""
    own = episodes.maps.known_cells - episodes.received  # known cells when the member sent its map
    return (own * episodes.merged).sum(-1).cumsum(-1)


def bytes_sent(episodes: Episodes, steps: Tensor | None = None) -> Tensor:
    """What all communicate actions send, int64 [B] (bytes): a whole map, two bits per cell.

    A robot sends whether or not anyone hears it.

    Args:
        episodes: B episodes.
        steps: bool [B, T], the steps to count; None: all.
    """
    sending = (episodes.action == COMMUNICATE) & episodes.acting
    if steps is not None:
        sending = sending & steps.unsqueeze(-1)
    sent = sending.flatten(1).sum(-1)
    return sent * -(-episodes.num_cells // CELLS_PER_BYTE)


def cells_received(episodes: Episodes) -> Tensor:
    """Cells that merges added to maps, int64 [B]."""
    return episodes.received.flatten(1).sum(-1)


def distance_travelled(episodes: Episodes) -> Tensor:
    """Path length of all robots, float64 [B] (metres): D per straight, sqrt(2) D per diagonal."""
    moves, diagonal = _moves(episodes)
    return _length(moves.sum(-1), diagonal.sum(-1), episodes.cell_size)


def until_completion(episodes: Episodes) -> Tensor:
    """Steps up to the first that completed a map, or all steps if none did, bool [B, T]."""
    known = largest_of_living(episodes.maps.known_targets, episodes.alive)
    last = steps_to(known, episodes.num_targets, 1.0)
    return torch.arange(episodes.horizon, device=last.device) < last.unsqueeze(-1)


def moves_of_robots(episodes: Episodes) -> Tensor:
    """Moves that each robot made until some map was complete, int64 [B, N]."""
    return _moves(episodes, until_completion(episodes))[0]


def distance_of_robots(episodes: Episodes) -> Tensor:
    """Path length of each robot until some map was complete, float64 [B, N] (metres)."""
    moves, diagonal = _moves(episodes, until_completion(episodes))
    return _length(moves, diagonal, episodes.cell_size)


def _moves(episodes: Episodes, steps: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Moves and, of them, diagonal ones of each robot at the steps to count, int64 [B, N] each."""
    sides = episodes.position.diff(dim=1).abs().sum(-1)  # 0, 1, or 2 for a diagonal
    if steps is not None:
        sides = sides * steps.unsqueeze(-1)
    return (sides > 0).sum(1), (sides > 1).sum(1)


def _length(moves: Tensor, diagonal: Tensor, cell_size: float) -> Tensor:
    """Length of paths with so many moves, some of them diagonal, float64 (metres)."""
    return (moves + (2**0.5 - 1) * diagonal.double()) * cell_size


def overlap(episodes: Episodes) -> Tensor:
    """Own discoveries of all robots over the union of the maps, minus 1, float64 [B]."""
    discovered = episodes.discovered.flatten(1).sum(-1).double()
    return discovered / episodes.maps.union_cells[:, -1] - 1


def shares(episodes: Episodes) -> dict[str, Share]:
    """Every share of events by name."""
    unfinished = before_completion(episodes)
    return {
        "communication_share": communication_share(episodes),
        "useful_share": useful_share(episodes),
        "communication_share_before_completion": communication_share(episodes, unfinished),
        "useful_share_before_completion": useful_share(episodes, unfinished),
        "enlarging_share": enlarging_share(episodes),
        "large_enlargement_share": large_enlargement_share(episodes),
        "dangerous_share": dangerous_share(episodes),
        "unlinked_share": unlinked_share(episodes),
    }


def per_episode(episodes: Episodes) -> dict[str, Tensor]:
    """Times, coverages and cells of every episode by name, float64 [B] each."""
    maps, targets = episodes.maps, episodes.num_targets
    largest = largest_of_living(maps.known_targets, episodes.alive)
    smallest = smallest_of_living(maps.known_targets, episodes.alive)
    curves, distance = coverage(episodes), distance_of_robots(episodes)
    scores: dict[str, Tensor] = {}
    for share in THRESHOLDS:
        percent = round(100 * share)
        scores[f"steps_to_{percent}"] = steps_to(largest, targets, share)
        scores[f"merged_steps_to_{percent}"] = steps_to(maps.union_targets, targets, share)
    scores["steps_to_all_complete"] = steps_to(smallest, targets, 1.0)
    scores["complete"] = (largest == targets.unsqueeze(-1)).any(-1)
    for step in (*COVERAGE_STEPS, episodes.horizon):
        if step <= episodes.horizon:
            scores[f"coverage_at_{step}"] = curves["largest"][:, step]
    scores |= {f"final_{name}_coverage": curve[:, -1] for name, curve in curves.items()}
    scores |= {
        "final_known_ratio": known_ratio(episodes)[:, -1],
        "cells_sent": cells_sent(episodes)[:, -1],
        "cells_received": cells_received(episodes),
        "bytes_sent": bytes_sent(episodes),
        "bytes_until_complete": bytes_sent(episodes, until_completion(episodes)),
        "distance_m": distance_travelled(episodes),
        "distance_mean_m": distance.mean(-1),
        "distance_longest_m": distance.amax(-1),
        "moves_longest": moves_of_robots(episodes).amax(-1),
        "overlap": overlap(episodes),
        "failed_robots": (~episodes.alive[:, -1]).sum(-1),
        "knowledge_lost": episodes.lost_targets / targets.double(),
        "finishable": episodes.finishable,
    }
    return {name: score.double() for name, score in scores.items()}


def summarize(episodes: Episodes) -> dict[str, float]:
    """Every measure by name: the mean over episodes, or the pooled share."""
    means = {name: float(score.mean()) for name, score in per_episode(episodes).items()}
    return means | {name: share.pooled for name, share in shares(episodes).items()}
