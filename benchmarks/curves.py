"""Cost of an environment step, with FPR and NET, against the size of the problem.

python -m benchmarks.curves [figure.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmarks.timing import conditions, medians
from marl_explore import ArenaConfig, make_env
from marl_explore.evaluation.plots.style import STYLE, line_styles, save

CURVES = {
    "side of the arena (cells)": {side: (64, 4, side) for side in (12, 32, 64, 128)},
    "robots": {robots: (64, robots, 12) for robots in (2, 4, 8, 16)},
    "arenas": {arenas: (arenas, 4, 12) for arenas in (8, 64, 512, 4096)},
}
"""Per curve its points: arenas, robots and side; the others stay as they are here."""
BACKENDS = ("native", "torch")


def step_of(num_envs: int, robots: int, side: int, backend: str):
    """One step of all arenas with random allowed actions, from episodes under way."""
    config = ArenaConfig(height=side, width=side, num_agents=robots)
    env = make_env(config, num_envs, max_steps=10**9, backend=backend)
    observation = env.rollout(3)[:, -1]["next"]

    def step():
        env.step(env.rand_action(observation))

    return step


def measure(points: dict[int, tuple[int, int, int]], repeats: int) -> dict[str, dict[int, float]]:
    """Microseconds per observation (a robot's step) of each backend, at each point."""
    costs: dict[str, dict[int, float]] = {backend: {} for backend in BACKENDS}
    for x, (num_envs, robots, side) in points.items():
        contenders = {b: step_of(num_envs, robots, side, b) for b in BACKENDS}
        for backend, seconds in medians(contenders, repeats).items():
            costs[backend][x] = seconds / (num_envs * robots) * 1e6
    return costs


def draw(curves: dict[str, dict[str, dict[int, float]]], path: str | Path) -> None:
    """All curves side by side, on logarithmic axes."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 3), layout="constrained")
        panels = figure.subplots(1, len(curves))
        for axes, (name, costs) in zip(panels, curves.items(), strict=True):
            for (_, cost), (_, style) in zip(costs.items(), line_styles(costs), strict=True):
                axes.plot(list(cost), list(cost.values()), marker="o", **style)
            axes.set(xscale="log", yscale="log", xlabel=name)
            axes.set_xticks(list(cost), list(map(str, cost)))
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25)
        figure.suptitle(
            "What a step of the environment costs, with FPR and NET",
            fontsize=STYLE["axes.titlesize"],
        )
        panels[0].set_ylabel("microseconds per observation")
        panels[0].legend()
        save(figure, path)


def main() -> None:
    torch.set_num_threads(1)
    curves = {}
    print(f"env.step with FPR and NET, us per observation, {conditions()}")
    for name, points in CURVES.items():
        curves[name] = measure(points, repeats=7)
        print(f"{name:>28}" + "".join(f"{x:>9}" for x in points))
        for backend, cost in curves[name].items():
            print(f"{backend:>28}" + "".join(f"{value:9.2f}" for value in cost.values()))
    if len(sys.argv) > 1:
        draw(curves, sys.argv[1])


if __name__ == "__main__":
    main()
