"""Search the weights of the planner ``goal-utility`` with an evolution strategy (CMA-ES).

python recipes/search_goal_utility.py --generations 40 --out goal-utility.json
python recipes/search_goal_utility.py --start goal-utility.json --generations 200 --out prior.json
python recipes/search_goal_utility.py --tasks wide --out wide-utility.json

Every generation plays each candidate on the same newly drawn training arenas of several suites and
team sizes; its loss is the mean number of steps to a complete map, relative to that of the weights
that the search starts from, on the same arenas. It needs ``pip install .[search]``.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from cmaes import CMA
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import step_mdp

from marl_explore import (
    ExplorationEnv,
    GoalUtility,
    GoalWeights,
    default_config,
    default_steps,
)
from marl_explore.planners.goal_utility import weight_tensor

TASKS = (
    ("paper-12", 4, 64),
    ("paper-12", 2, 24),
    ("paper-12", 3, 24),
    ("paper-12", 6, 32),
    ("paper-12", 8, 32),
    ("open-24", 4, 32),
    ("open-24", 6, 16),
    ("corridor-24", 4, 16),
    ("rooms-32", 4, 12),
    ("maze-32", 4, 12),
    ("cave-48", 4, 8),
)
"""Suite, robots, and arenas per generation."""
WIDE_TASKS = (
    ("lidar-32", 4, 16),
    ("radio-32", 4, 16),
    ("mixed-team-32", 4, 16),
    ("faulty-32", 6, 16),
)
"""The same beyond the paper's world."""
PATIENCE = 1.6
"""Episodes end after so many times the mean number of steps of the weights at the start."""
START = GoalWeights(
    moves=0.144,
    log_moves=0.228,
    near_gain=2.09,
    middle_gain=-1.09,
    far_gain=-1.93,
    merged_cells=0.416,
    pocket=0.684,
    isolation=0.486,
    last_goal=0.331,
    ahead=-0.104,
    move_gain=0.842,
    linked_rival=2.317,
    rival_scale=1.798,
    knowing_rival=1.86,
    unknowing_rival=0.535,
    arrived_rival=0.867,
    memory=118.7,
    mate_moves=0.07,
    mate_age=0.196,
    mate_unshared=-0.761,
    timer=7.7,
    start=2.0,
)
"""Of an earlier search by the same method with a few more features."""
SCALES = GoalWeights(
    moves=0.05,
    log_moves=0.2,
    near_gain=0.3,
    middle_gain=0.4,
    far_gain=0.6,
    merged_cells=0.2,
    pocket=0.3,
    isolation=0.2,
    last_goal=0.2,
    ahead=0.1,
    move_gain=0.3,
    linked_rival=0.4,
    rival_scale=0.5,
    knowing_rival=0.3,
    unknowing_rival=0.3,
    arrived_rival=0.3,
    memory=30.0,
    mate_moves=0.05,
    mate_age=0.5,
    mate_unshared=0.5,
    timer=1.5,
    start=0.3,
)
"""One standard deviation of each weight at sigma = 1."""
LOWEST = {"rival_scale": 0.2, "memory": 1.0, "timer": 1.0, "start": 0.0}
"""Bounds of weights that have one."""


@dataclass(frozen=True)
class Arguments:
    """Options of the search."""

    generations: int = 40
    population: int = 12
    sigma: float = 0.4
    """Initial standard deviation, in ``SCALES``."""
    average: int = 10
    """The result is the mean of the last so many generations' means."""
    seed: int = 0
    start: Path | None = None
    """File of an earlier search, from whose weights to start."""
    first: int = 1000
    """Number of the first training arena; searches one after the other take others."""
    tasks: Literal["paper", "wide"] = "paper"
    """The arenas: in the paper's world, or in the four suites of wider ones."""
    out: Path = Path("goal-utility.json")


@torch.no_grad()
def play(
    weights: Tensor, suite: str, robots: int, first: int, arenas: int, steps: int | None = None
) -> Tensor:
    """Steps until the largest map is complete, [candidates, arenas]; ``steps`` + 1 if it is not.

    Args:
        weights: of every candidate, [candidates, 22].
        suite, robots: the task.
        first: number of the first training arena.
        arenas: how many.
        steps: most steps; None: those of the suite.
    """
    config = replace(default_config(suite), num_agents=robots)
    steps = steps or default_steps(suite)
    drawn = ExplorationEnv(
        config, num_envs=arenas, arenas=suite, stream="train", first_arena=first
    ).reset()
    candidates = len(weights)
    batch = candidates * arenas

    def repeated(entry: Tensor) -> Tensor:
        return entry.repeat(candidates, *[1] * (entry.ndim - 1))

    start = TensorDict(
        {
            "obstacles": repeated(drawn["obstacles"]),
            "draw_key": repeated(drawn["draw_key"]),
            "agents": {"position": repeated(drawn["agents", "position"])},
        },
        batch_size=[batch],
    )
    env = ExplorationEnv(config, num_envs=batch, max_steps=steps, terminate_at_coverage=1.0)
    observed = env.reset(start, set_state=True)
    each = weights.repeat_interleave(arenas, 0).unsqueeze(1)  # of all robots of an arena
    planner = GoalUtility(config.sight, each, config)
    needed = torch.full((batch,), steps + 1)
    for step in range(1, steps + 1):
        observed = step_mdp(env.step(planner(observed)))
        complete = observed["terminated"].squeeze(-1)
        needed = torch.where(complete, needed.clamp_max(step), needed)
        if complete.all():
            break
    return needed.view(candidates, arenas)


def as_weights(start: Tensor, points: np.ndarray) -> Tensor:
    """The weights [candidates, 22] at points of a search that starts from weights [22]."""
    weights = start + weight_tensor(SCALES) * torch.from_numpy(points).float()
    lowest = [LOWEST.get(field.name, -torch.inf) for field in fields(GoalWeights)]
    return weights.maximum(torch.tensor(lowest))


def read_start(path: Path | None) -> Tensor:
    """The weights [22] of an earlier search; None: ``START``."""
    given = START if path is None else GoalWeights(**json.loads(path.read_text())["weights"])
    return weight_tensor(given)


def main(arguments: Arguments) -> None:
    """Run the search; the file holds the result and every generation's loss."""
    torch.manual_seed(arguments.seed)
    size = len(fields(GoalWeights))
    search = CMA(
        mean=np.zeros(size),
        sigma=arguments.sigma,
        population_size=arguments.population,
        seed=arguments.seed,
    )
    start = read_start(arguments.start)
    tasks = WIDE_TASKS if arguments.tasks == "wide" else TASKS
    usual = [play(start[None], suite, n, 0, 4 * k).double().mean() for suite, n, k in tasks]
    most = [round(PATIENCE * float(steps)) for steps in usual]
    means, history, begun = [], [], time.perf_counter()
    for generation in range(arguments.generations):
        points = [search.ask() for _ in range(arguments.population)]
        weights = torch.cat((as_weights(start, np.stack(points)), start[None]))
        loss = np.zeros(arguments.population)
        for (suite, robots, arenas), steps in zip(tasks, most, strict=True):
            first = arguments.first + 1000 * generation
            needed = play(weights, suite, robots, first, arenas, steps).double().mean(-1)
            loss += (needed[:-1] / needed[-1]).numpy() / len(tasks)
        search.tell([*zip(points, loss.tolist(), strict=True)])
        means.append(search.mean.copy())
        history.append({"best": loss.min(), "mean": loss.mean(), "spread": float(np.std(points))})
        found = as_weights(start, np.mean(means[-arguments.average :], 0)[None])
        names = [field.name for field in fields(GoalWeights)]
        result = {n: round(value, 4) for n, value in zip(names, found[0].tolist(), strict=True)}
        steps_at_start = [float(steps) for steps in usual]
        record = {"weights": result, "tasks": tasks, "usual_steps": steps_at_start}
        arguments.out.write_text(json.dumps(record | {"generations": history}, indent=1))
        seconds = time.perf_counter() - begun
        print(
            f"{generation + 1:3} {seconds:6.0f} s  best {loss.min():.3f}  mean {loss.mean():.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
