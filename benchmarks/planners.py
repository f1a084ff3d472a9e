"""A team's decision by the planners that coordinate robots, in large arenas and in large teams.

python -m benchmarks.planners

Milliseconds of one decision of all robots, and how many times as long it takes as one of `nearest`,
where every robot is on its own. The teams have explored for a while.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDictBase

from benchmarks.timing import conditions, medians
from marl_explore import PLANNERS, ArenaConfig, ExplorationEnv, Rooms, play

ASSIGNMENTS = ("nearest", "utility-cost", "sequential", "hungarian")
WIDE = ArenaConfig(height=128, width=128, num_agents=16)
FLOOR = ArenaConfig(height=64, width=64, num_agents=50, obstacle_density=0.15)
CROWD = ArenaConfig(num_agents=16)
SITUATIONS: dict[str, tuple[ArenaConfig, int, tuple[str, ...]]] = {
    "16 robots, 128 x 128": (WIDE, 100, ASSIGNMENTS),
    "the same, all linked": (
        ArenaConfig(height=128, width=128, num_agents=16, communication_range=math.inf),
        100,
        ASSIGNMENTS,
    ),
    "50 robots, rooms 64 x 64": (FLOOR, 60, ASSIGNMENTS),
    "16 robots, 12 x 12": (CROWD, 4, (*ASSIGNMENTS, "rendezvous", "central")),
}
"""Arenas, steps that have been made in them, and the planners to measure."""


def situation(config: ArenaConfig, steps: int) -> TensorDictBase:
    """The observation after some steps of `utility-cost`."""
    arenas = Rooms(config, starts="clustered") if config is FLOOR else "uniform"
    env = ExplorationEnv(config, arenas=arenas, stream="validation", max_steps=steps + 1)
    torch.manual_seed(0)
    *_, last = play(PLANNERS["utility-cost"](config), env, steps)
    return last


def measure(name: str, repeats: int = 7) -> dict[str, float]:
    """Median milliseconds of a decision of each planner in a situation."""
    config, steps, names = SITUATIONS[name]
    now = situation(config, steps)

    def contender(planner: str) -> Callable[[], object]:
        return partial(_decide, PLANNERS[planner](config), now)

    seconds = medians({planner: contender(planner) for planner in names}, repeats)
    return {planner: 1000 * value for planner, value in seconds.items()}


def _decide(planner: Callable[[TensorDictBase], object], now: TensorDictBase) -> object:
    return planner(now.clone(recurse=False))


def main() -> None:
    torch.set_num_threads(1)
    print(f"one decision of a team, {conditions()}")
    for name in SITUATIONS:
        found = measure(name)
        for planner, milliseconds in found.items():
            ratio = milliseconds / found["nearest"]
            print(f"{name:>26} {planner:>14} {milliseconds:9.1f} ms {ratio:7.2f} x nearest")


if __name__ == "__main__":
    main()
