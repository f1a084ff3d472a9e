"""FPR of many arenas in one call against plain Python, per observation, in one run.

python -m benchmarks.frontier
"""

from __future__ import annotations

import torch

from benchmarks.baselines import astar_table, bfs_table
from benchmarks.timing import conditions, medians
from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core import native
from marl_explore.core.frontier import feature_table
from marl_explore.core.native import operator
from marl_explore.planners import PLANNERS


def observations(num_envs: int, steps: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps [M, H, W] and positions [M, 2] from episodes under way, at staggered times."""
    config = ArenaConfig()
    rollout = ExplorationEnv(config, num_envs).rollout(steps, PLANNERS["nearest-timer"](config))
    rows = torch.arange(num_envs)
    sample = rollout[rows, rows % steps]["agents"]
    return sample["map"].flatten(0, 1), sample["position"].flatten(0, 1)


def measure(num_envs: int = 512, repeats: int = 7, sample: int = 200) -> dict[str, float]:
    """Median microseconds per observation of ours and of plain Python, interleaved."""
    maps, positions = observations(num_envs)
    few = torch.linspace(0, len(maps) - 1, min(sample, len(maps))).long()
    plain = [
        (grid, tuple(cell))
        for grid, cell in zip(maps[few].tolist(), positions[few].tolist(), strict=True)
    ]
    contenders = {
        "torch": (lambda: feature_table(maps, positions), len(maps)),
        "A* per frontier": (lambda: [astar_table(*p) for p in plain], len(plain)),
        "BFS per robot": (lambda: [bfs_table(*p) for p in plain], len(plain)),
    }
    if native.missing() is None:
        contenders["native"] = (lambda: operator.feature_table(maps, positions), len(maps))
    seconds = medians({name: function for name, (function, _) in contenders.items()}, repeats)
    return {name: seconds[name] / count * 1e6 for name, (_, count) in contenders.items()}


def main() -> None:
    torch.set_num_threads(1)
    result = measure()
    print(f"FPR, 512 arenas x 4 robots, 12 x 12 cells, {conditions()}")
    ours = [name for name in ("torch", "native") if name in result]
    print(f"{'us per observation':>36}" + "".join(f"{'over ' + name:>14}" for name in ours))
    for name, value in result.items():
        ratios = "".join(f"{value / result[other]:14.1f}" for other in ours)
        print(f"{name:>18}{value:18.2f}{ratios}")


if __name__ == "__main__":
    main()
