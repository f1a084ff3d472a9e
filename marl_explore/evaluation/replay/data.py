"""The data of an episode in a replay, as numbers for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.grid import UNKNOWN
from marl_explore.core.mapping import known_mask, target_cells
from marl_explore.core.sensing import UNSEEN, bordered, surroundings
from marl_explore.core.survivors import largest_of_living
from marl_explore.core.world import carrying
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
        "seen": _seen(obstacles, position, config),
        "obstacles": obstacles.flatten().nonzero().flatten().tolist(),
        "known_since": since.flatten(1).tolist(),
        "cell": (position[..., 0] * config.width + position[..., 1]).tolist(),
        "refused": _over_time(steps, arena, "dangerous").int().tolist(),
        "received": _over_time(steps, arena, "received").tolist(),
        **_radio(steps, arena, config),
        **_events(steps, arena, config),
        **_coverage(maps, target_cells(obstacles, position[0]), _over_time(steps, arena, "alive")),
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


def _radio(steps: Sequence[TensorDictBase], arena: int, config: ArenaConfig) -> dict[str, Any]:
    """Actions, and the pairs of robots that were linked and that exchanged their maps."""
    linked = _over_time(steps, arena, "linked")
    key, now = (
        torch.stack([step[name][arena] for step in steps]).cpu()
        for name in ("draw_key", "step_count")
    )
    actions = [step["agents", "action"][arena].cpu() for step in steps[1:]]
    together = _over_time(steps, arena, "steps_since_merge") == 0
    merging = together & carrying(config, linked, key, now - 1)
    return {
        "action": [[], *(action.tolist() for action in actions)],
        "linked": [_pairs(matrix) for matrix in linked],
        "merging": [_pairs(matrix) for matrix in merging],
    }


def _pairs(matrix: Tensor) -> list[list[int]]:
    """Pairs i < j of a symmetric matrix, bool [N, N]."""
    pairs: list[list[int]] = matrix.triu(1).nonzero().tolist()
    return pairs


def _events(steps: Sequence[TensorDictBase], arena: int, config: ArenaConfig) -> dict[str, Any]:
    """From which step each robot had failed, T + 1 if never; and the cells of walkers."""
    failed_since = _over_time(steps, arena, "alive").sum(0).tolist()
    if not config.num_walkers:
        return {"failed_since": failed_since, "walkers": []}
    walkers = torch.stack([step["walkers"][arena] for step in steps]).cpu()
    cells = walkers[..., 0] * config.width + walkers[..., 1]
    return {"failed_since": failed_since, "walkers": cells.tolist()}


def _seen(obstacles: Tensor, position: Tensor, config: ArenaConfig) -> list[list[str]] | None:
    """The cells that each robot sees: bits of its window, row by row, in hexadecimal digits.

    None if the robots see all of their windows. In a step in which a robot fails, and later, it
    sees nothing; the player knows.
    """
    if config.sight.fills_windows:
        return None
    walls = bordered(obstacles, config.fov_radius).expand(len(position), -1, -1)
    seen = (surroundings(walls, position, config.sight) != UNSEEN).flatten(-2)
    digits = torch.nn.functional.pad(seen, (0, -seen.shape[-1] % 4)).unflatten(-1, (-1, 4))
    values = (digits * torch.tensor((8, 4, 2, 1))).sum(-1).tolist()
    return [["".join(f"{digit:x}" for digit in robot) for robot in step] for step in values]


def _coverage(maps: Tensor, target: Tensor, alive: Tensor) -> dict[str, Any]:
    """Target cells, and how many of them each robot and the union of living maps knew."""
    counts = snapshot(maps, target.unsqueeze(0), alive)
    return {
        "num_targets": int(target.sum()),
        "known_targets": counts.known_targets.tolist(),
        "largest_targets": largest_of_living(counts.known_targets, alive).tolist(),
        "union_targets": counts.union_targets.tolist(),
    }


def _frontiers(maps: Tensor, position: Tensor) -> dict[str, Any]:
    """FPR in cells: number and mean length of paths to frontiers, per robot and direction."""
    table = FrontierReachability(normalize=None).compute(maps, position)
    length = (100 * table[..., 1].double()).round() / 100  # fewer digits
    return {"paths": table[..., 0].int().tolist(), "path_length": length.tolist()}
