"""Cost of an environment step in the wider world: lidars and walls, teams, ranges and large arenas.

python -m benchmarks.worlds
"""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks.timing import conditions, medians
from marl_explore import ArenaConfig, make_env, suite
from marl_explore.arenas import resolve

LIDAR = ArenaConfig(sensing_range=3.5, sensing_shape="disc", line_of_sight=True, wall_loss_db=6.0)
CURVES = {
    "radius of a disc with line of sight (cells)": {
        k: (64, replace(LIDAR, height=32, width=32, sensing_range=0.5 * k)) for k in (2, 4, 7, 10)
    },
    "robots, 24 x 24 cells": {n: (16, ArenaConfig(24, 24, num_agents=n)) for n in (4, 16, 64, 100)},
    "robots with lidars, 24 x 24 cells": {
        n: (16, replace(LIDAR, height=24, width=24, num_agents=n)) for n in (4, 16, 64, 100)
    },
    "side of the arena, lidars (cells)": {
        side: (8, replace(LIDAR, height=side, width=side)) for side in (32, 64, 128, 256)
    },
}
"""Per curve its points: number of arenas and their settings."""


def step_of(num_envs, config, arenas="uniform-v2", begun=20):
    """One step of all arenas with random allowed actions, from episodes under way."""
    env = make_env(config, num_envs, max_steps=10**9, arenas=arenas)
    observation = env.rollout(begun)[:, -1]["next"]

    def step():
        env.step(env.rand_action(observation))

    return step


def lidar_and_plain(num_envs: int, repeats: int) -> dict[str, float]:
    """Seconds of a step of ``lidar-32``, and of the same arenas in the paper's world."""
    config = suite("lidar-32").config
    arenas = resolve("lidar-32", config)
    plain = ArenaConfig(config.height, config.width, config.obstacle_density)
    contenders = {
        "lidar-32": step_of(num_envs, config, arenas),
        "3 x 3, radio by range": step_of(num_envs, plain, arenas),
    }
    return medians(contenders, repeats)


def curve(points: dict[int, tuple[int, ArenaConfig]], repeats: int) -> dict[int, float]:
    """Microseconds of an observation (a robot's step) at each point."""
    costs = {}
    for x, (num_envs, config) in points.items():
        seconds = medians({"step": step_of(num_envs, config)}, repeats)["step"]
        costs[x] = seconds / (num_envs * config.num_agents) * 1e6
    return costs


def main() -> None:
    torch.set_num_threads(1)
    print(f"env.step with FPR and NET, {conditions()}")
    seconds = lidar_and_plain(512, repeats=9)
    for name, value in seconds.items():
        ratio = value / seconds["3 x 3, radio by range"]
        print(f"{name:>24}, 512 arenas: {1000 * value:7.2f} ms, {ratio:.2f} times")
    for name, points in CURVES.items():
        cost = curve(points, repeats=7)
        print(f"{name:>46}" + "".join(f"{x:>9}" for x in points))
        print(f"{'us per observation':>46}" + "".join(f"{value:9.2f}" for value in cost.values()))


if __name__ == "__main__":
    main()
