"""Draws concepts.png of docs/concepts.md: python docs/images/concepts.py"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Circle, Rectangle
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore import ArenaConfig, FrontierReachability, find_policy, watch

ROBOTS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"]
CELLS = ListedColormap(["#c8c8c8", "white", "#404040"])  # unknown, free, occupied
STEPS = np.array([(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)])


def find_chain() -> tuple[ArenaConfig, TensorDictBase, TensorDictBase, Tensor]:
    """The first test arena in which three robots exchange maps, two of them out of range.

    Returns:
        Settings, the observations before and after, and the robots of the chain, its middle second.
    """
    config = ArenaConfig(communication_range=2.0)
    policy = find_policy("nearest-timer", config)
    for arena in range(100):
        episode = watch(policy, config, arena_index=arena, steps=60)
        for before, after in pairwise(episode[8:]):
            merged, linked = after["agents", "merged"][0], after["agents", "linked"][0]
            members = merged.nonzero().flatten()
            among = linked[members][:, members].sum(-1)
            if len(members) == 3 and sorted(among.tolist()) == [2, 2, 3]:
                return config, before, after, members[among.argsort(stable=True)][[0, 2, 1]]
    raise RuntimeError("no chain of three robots was found")


def draw_cells(axes: Axes, cells: Tensor, title: str) -> None:
    """A map: -1 unknown, 0 free, 1 occupied; [H, W]."""
    axes.imshow(cells, cmap=CELLS, vmin=-1, vmax=1)
    axes.set_title(title, fontsize=10)
    axes.set(xticks=[], yticks=[])


def draw_robots(axes: Axes, position: Tensor, robots: list[int]) -> None:
    """Dots with their numbers."""
    for robot in robots:
        row, column = position[robot].tolist()
        axes.add_patch(Circle((column, row), 0.38, color=ROBOTS[robot], zorder=3))
        axes.text(column, row, str(robot), color="w", ha="center", va="center", zorder=4)


def main() -> None:
    """Draw the three panels."""
    config, before, after, chain = find_chain()
    position = after["agents", "position"][0]
    linked = after["agents", "linked"][0]
    own = int(chain[0])
    row, column = position[own].tolist()

    figure, (world, known, joined) = plt.subplots(1, 3, figsize=(10.5, 3.9), layout="constrained")
    draw_cells(world, after["obstacles"][0].long(), "The arena, which nobody knows")
    for a in range(config.num_agents):
        for b in range(a):
            if linked[a, b]:
                rows, columns = position[[a, b]].T
                world.plot(columns, rows, color="#555555", linewidth=3)
    reach = config.communication_cells
    world.add_patch(Circle((column, row), reach, fill=False, color=ROBOTS[own], linestyle=":"))
    world.set(xlim=(-0.5, config.width - 0.5), ylim=(config.height - 0.5, -0.5))
    for robot in chain:
        at = position[robot].tolist()[::-1]
        world.add_patch(Circle(at, 0.6, fill=False, color=ROBOTS[int(robot)], linewidth=2))
    draw_robots(world, position, [*range(config.num_agents)])

    # the map just before the exchange: that of the step before, and what it has sensed since
    k, side = config.fov_size // 2, config.fov_size
    map_before = before["agents", "map"][0, own].clone()
    near = (
        slice(max(row - k, 0), row + k + 1),
        slice(max(column - k, 0), column + k + 1),
    )
    map_before[near] = after["agents", "map"][0, own][near]
    draw_cells(known, map_before, f"What robot {own} knows and sees")
    window = (column - k - 0.5, row - k - 0.5)
    known.add_patch(Rectangle(window, side, side, fill=False, color=ROBOTS[own], linewidth=2))
    table = FrontierReachability("map", "at", out_key="fpr")(
        before.empty().update({"map": map_before[None], "at": position[own][None]})
    )["fpr"][0]
    lengths = np.linalg.norm(STEPS, axis=1, keepdims=True)
    for step, share in zip(STEPS / lengths, table[:, 0], strict=True):
        if share:
            down, right = step * (1 + 5 * float(share))
            known.annotate(
                "",
                (column + right, row + down),
                (column, row),
                arrowprops={"arrowstyle": "-|>", "color": ROBOTS[own], "linewidth": 1.8},
            )
    draw_robots(known, position, [own])

    draw_cells(joined, after["agents", "map"][0, own], f"What robot {own} knows after the exchange")
    in_range = [i for i in range(config.num_agents) if linked[own, i]]
    draw_robots(joined, position, in_range)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
