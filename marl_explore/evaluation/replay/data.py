"""The data of an episode in a replay, as numbers for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.communication import networks
from marl_explore.core.grid import COMMUNICATE, UNKNOWN
from marl_explore.core.mapping import known_mask, target_cells
from marl_explore.evaluation.metrics import snapshot
from marl_explore.transforms import FrontierReachability


def episode_data(
    steps: Sequence[TensorDictBase], config: ArenaConfig, arena: int = 0
) -> dict[str, Any]:
    """One arena's episode as plain numbers; lists over time have T + 1 entries, from the reset on.

    A known cell stays known and agrees with the arena, so all maps of a robot are one number per
    cell: the step from which it is known, or T + 1 if never. Cells are row * W + column.

    Args:
        steps: observations of an episode in order with the actions that led to them, each with
            batch [B], as ``evaluation.play`` yields them.
        config: arena, robots and ranges of the episode.
        arena: row of the batch.

    Raises:
        ValueError: when there are no steps, the row does not exist, the sizes differ from
            ``config``, or the maps are not those of one episode.
        KeyError: naming an entry that a step lacks.
    """
    if not steps:
        raise ValueError("steps is empty: an episode has at least the observation of its reset")
    if not 0 <= arena < steps[0].shape[0]:
        raise ValueError(f"arena={arena!r} is not a row of a batch of {steps[0].shape[0]}")
    obstacles = steps[0]["obstacles"][arena].cpu()
    maps = _over_time(steps, arena, "map")
    position = _over_time(steps, arena, "position")
    _check_size(maps, config)
    since = len(maps) - known_mask(maps).sum(0)
    _check_order(maps, obstacles, since)
    return {
        "height": config.height,
        "width": config.width,
        "fov_radius": config.fov_radius,
        "obstacles": obstacles.flatten().nonzero().flatten().tolist(),
        "known_since": since.flatten(1).tolist(),
        "cell": (position[..., 0] * config.width + position[..., 1]).tolist(),
        "refused": _over_time(steps, arena, "dangerous").int().tolist(),
        "received": _over_time(steps, arena, "received").tolist(),
        **_radio(steps, arena, _over_time(steps, arena, "linked")),
        **_coverage(maps, target_cells(obstacles, position[0])),
        **_frontiers(maps, position),
    }


def _over_time(steps: Sequence[TensorDictBase], arena: int, key: str) -> Tensor:
    """An entry of the robots in one arena, [steps, N, ...]."""
    return torch.stack([step["agents", key][arena] for step in steps]).cpu()


def _check_size(maps: Tensor, config: ArenaConfig) -> None:
    got, wanted = tuple(maps.shape[1:]), (config.num_agents, config.height, config.width)
    if got != wanted:
        raise ValueError(
            f"config: robots, height and width are {wanted}, those of the episode {got}"
        )


def _check_order(maps: Tensor, obstacles: Tensor, since: Tensor) -> None:
    """Check that ``since`` [N, H, W] and the arena reproduce the maps [T + 1, N, H, W]."""
    time = torch.arange(len(maps)).view(-1, 1, 1, 1)
    known = torch.where(since <= time, obstacles.to(maps.dtype), UNKNOWN)
    if not known.equal(maps):
        step = int((known != maps).flatten(1).any(1).nonzero()[0])
        raise ValueError(
            f"steps are not one episode in order: at step {step} a map forgot cells or shows "
            "another arena"
        )


def _radio(steps: Sequence[TensorDictBase], arena: int, linked: Tensor) -> dict[str, Any]:
    """Actions, and the pairs of robots that were linked and that exchanged their maps."""
    actions = [step["agents", "action"][arena].cpu() for step in steps[1:]]
    communicating = torch.zeros_like(linked[..., 0])  # nobody, before the reset
    for t, action in enumerate(actions, 1):
        communicating[t] = action == COMMUNICATE
    merging = linked & networks(linked, communicating)
    return {
        "action": [[], *(action.tolist() for action in actions)],
        "linked": [_pairs(matrix) for matrix in linked],
        "merging": [_pairs(matrix) for matrix in merging],
    }


def _pairs(matrix: Tensor) -> list[list[int]]:
    """Pairs i < j of a symmetric matrix, bool [N, N]."""
    pairs: list[list[int]] = matrix.triu(1).nonzero().tolist()
    return pairs


def _coverage(maps: Tensor, target: Tensor) -> dict[str, Any]:
    """Target cells, and how many of them each robot and the union of the maps knew."""
    counts = snapshot(maps, target.unsqueeze(0))
    return {
        "num_targets": int(target.sum()),
        "known_targets": counts.known_targets.tolist(),
        "union_targets": counts.union_targets.tolist(),
    }


def _frontiers(maps: Tensor, position: Tensor) -> dict[str, Any]:
    """FPR in cells: number and mean length of paths to frontiers, per robot and direction."""
    table = FrontierReachability(normalize=None).compute(maps, position)
    length = (100 * table[..., 1].double()).round() / 100  # fewer digits
    return {"paths": table[..., 0].int().tolist(), "path_length": length.tolist()}
