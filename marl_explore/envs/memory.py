"""Memory of an environment, estimated before it is made."""

from __future__ import annotations

from marl_explore.config.arena import ArenaConfig
from marl_explore.utils.memory import require_memory

BYTES_PER_CELL = 24
"""Of a robot's map and what is computed from it, per cell; measured: 34 to 52."""
BYTES_PER_PAIR = 32
"""Of what every robot counts about every other."""


def require_env_memory(config: ArenaConfig, num_envs: int) -> None:
    """Raise an error for an environment that does not fit this machine.

    The estimate is low, so that nothing is refused that would fit.

    Raises:
        ValueError: naming arenas, sizes and robots.
    """
    robots = config.num_agents
    arena = robots * (BYTES_PER_CELL * config.num_cells + BYTES_PER_PAIR * robots)
    seen = 4 * robots * config.fov_size**2
    require_memory(
        f"num_envs={num_envs} arenas of {config.height} x {config.width} cells with "
        f"num_agents={robots} and a field of view of {config.fov_size} x {config.fov_size}",
        num_envs * (arena + seen),
    )
