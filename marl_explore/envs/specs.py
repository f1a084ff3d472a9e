"""Names, shapes, dtypes and bounds of everything that the environment reads and writes."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.grid import NUM_ACTIONS
from marl_explore.core.world import NEVER
from marl_explore.envs.masks import AllowedActions, CurrentMask


class ExplorationSpecs(NamedTuple):
    """The specs of an ``ExplorationEnv`` (docs/environment.md lists the entries)."""

    state: Composite
    observation: Composite
    action: Composite
    reward: Composite
    done: Composite


def exploration_specs(
    config: ArenaConfig, batch_size: torch.Size, device: torch.device, current: CurrentMask
) -> ExplorationSpecs:
    """Specs for a batch [B] of arenas, whose random actions obey the ``current`` mask."""
    robots, side, cells = config.num_agents, config.fov_size, config.num_cells
    size = (config.height, config.width)

    def integer(low: int, high: int, *shape: int, dtype: torch.dtype = torch.int64) -> Bounded:
        return Bounded(low, high, shape=(*batch_size, *shape), dtype=dtype, device=device)

    def cell(*shape: int) -> Bounded:
        last = torch.tensor(size, device=device).expand(*batch_size, *shape, 2) - 1
        return Bounded(torch.zeros_like(last), last, dtype=torch.int64, device=device)

    def real(*shape: int) -> Unbounded:
        return Unbounded(shape=(*batch_size, *shape), dtype=torch.float32, device=device)

    def flag(*shape: int) -> Binary:
        return Binary(shape=(*batch_size, *shape), dtype=torch.bool, device=device)

    def entire(**entries: Any) -> Composite:
        return Composite(**entries, shape=batch_size, device=device)

    def group(**entries: Any) -> Composite:
        return Composite(**entries, shape=(*batch_size, robots), device=device)

    def world() -> tuple[dict[str, Any], dict[str, Any]]:
        """The state's entries of the root and of the group, newly created for every spec."""
        walkers = {"walkers": cell(config.num_walkers)} if config.num_walkers else {}
        return {
            "obstacles": flag(*size),
            "step_count": Unbounded(shape=(*batch_size, 1), dtype=torch.int64, device=device),
            "draw_key": Unbounded(shape=(*batch_size, 1), dtype=torch.int64, device=device),
            **walkers,
        }, {
            "map": integer(-1, 1, robots, *size, dtype=torch.int8),
            "position": cell(robots),
            "alive": flag(robots),
            "unshared": integer(0, cells, robots, robots),
            "steps_since_merge": integer(0, NEVER, robots, robots),
        }

    fov = Bounded(0, 1, (*batch_size, robots, side, side), dtype=torch.float32, device=device)
    seen = {
        "linked": flag(robots, robots),
        "action_mask": flag(robots, NUM_ACTIONS),
        "observation": group(fov=fov),
        "dangerous": flag(robots),
        "merged": flag(robots),
        "discovered": integer(0, cells, robots),
        "received": integer(0, cells, robots),
        "individual_reward": real(robots, 1),
    }
    root, agents = world()
    observed_root, observed_agents = world()
    action = AllowedActions(NUM_ACTIONS, shape=(*batch_size, robots), device=device)
    action.current = current
    ends = ("done", "terminated", "truncated")
    return ExplorationSpecs(
        state=entire(**root, agents=group(**agents)),
        observation=entire(**observed_root, agents=group(**observed_agents, **seen)),
        action=entire(agents=group(action=action)),
        reward=entire(reward=real(1)),
        done=entire(**{end: Categorical(2, (*batch_size, 1), device, torch.bool) for end in ends}),
    )
