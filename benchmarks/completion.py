"""Steps until the largest map is complete, of several training seeds, by kind of arenas and team.

python -m benchmarks.completion POLICY[,POLICY...] OTHER ... --tasks open-24/4:1000 --seed 3

A policy is any name that ``marl-explore evaluate`` takes; with commas between them, policies are
training seeds of one. Task ``open-24/6:200`` is 200 test arenas of the suite with 6 robots. Others
are compared with the first on the same arenas: difference of the means, and its 95 % bootstrap
interval over seeds and arenas. Actions are counted until the map of an arena is complete.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from marl_explore import default_config, default_steps
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.grid import COMMUNICATE
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.evaluation.episodes import TEST_STREAM, play
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.stats import paired_difference

TASKS = (
    "paper-12/4:1000 open-24/4:1000 corridor-24/4:200 rooms-32/4:100 maze-32/4:100 cave-48/4:300 "
    "paper-12/2:300 paper-12/3:300 paper-12/6:300 paper-12/8:300 open-24/6:200 open-24/8:200"
)
"""Suite, robots and number of arenas."""
HEAD = "task | policy | steps | of each seed | p90 | incomplete | communicate | useful | first - it"


@dataclass
class Count:
    """What a policy did on one task."""

    steps: list[list[int]] = field(default_factory=list)
    """Of every seed and arena; one more than the longest episode if it was not completed."""
    actions: int = 0
    communications: int = 0
    useful: int = 0
    """Communications that enlarged the sender's map."""
    incomplete: int = 0


def read_task(task: str) -> tuple[str, ArenaConfig, int]:
    """Kind of arenas, the team in them and the number of arenas of a task, "open-24/6:200"."""
    where, _, number = task.partition(":")
    arenas, _, robots = where.partition("/")
    return arenas, replace(default_config(arenas), num_agents=int(robots)), int(number)


def measure(names: str, task: str, seed: int, stream: str = TEST_STREAM) -> Count:
    """Play a task with every training seed of a policy."""
    arenas, config, number = read_task(task)
    longest, count = default_steps(arenas), Count()
    for name in names.split(","):
        torch.manual_seed(seed)
        env = ExplorationEnv(
            config,
            num_envs=number,
            max_steps=longest,
            arenas=arenas,
            seed=seed,
            stream=stream,
            terminate_at_coverage=1.0,
        )
        steps = torch.full((number,), longest + 1)
        for step, seen in enumerate(play(find_policy(name, config), env, longest, True)):
            if step == 0:
                continue
            running = steps > longest
            talks = (seen["agents", "action"] == COMMUNICATE)[running]
            count.actions += talks.numel()
            count.communications += int(talks.sum())
            count.useful += int((talks & (seen["agents", "received"][running] > 0)).sum())
            steps[running & seen["terminated"].squeeze(-1)] = step
        count.steps.append(steps.tolist())
        count.incomplete += int((steps > longest).sum())
    return count


def row(task: str, names: str, count: Count, first: Count | None) -> str:
    """A line of the table."""
    steps = np.array(count.steps)
    means = ", ".join(f"{mean:.2f}" for mean in steps.mean(1))
    told = f"{count.communications / count.actions:.3f}"
    useful = f"{count.useful / max(count.communications, 1):.2f}"
    cells = [task, names, f"{steps.mean():.2f}", means, f"{np.quantile(steps, 0.9):.0f}"]
    cells += [str(count.incomplete), told, useful]
    if first is None:
        return " | ".join([*cells, "-"])
    value, low, high = paired_difference(np.array(first.steps), steps)
    share = 100 * value / steps.mean()
    return " | ".join([*cells, f"{value:+.2f} [{low:+.2f}, {high:+.2f}], {share:+.1f} %"])


def main() -> None:
    """Measure and print; the steps of every arena go to ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--tasks", nargs="+", default=TASKS.split())
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stream", default=TEST_STREAM)
    parser.add_argument("--out", type=Path)
    words = parser.parse_args()
    torch.set_num_threads(1)
    print(HEAD)
    kept: dict[str, dict[str, list[list[int]]]] = {}
    for task in words.tasks:
        first = None
        for names in words.policies:
            with torch.no_grad():
                count = measure(names, task, words.seed, words.stream)
            print(row(task, names, count, first), flush=True)
            first = first or count
            kept.setdefault(task, {})[names] = count.steps
            if words.out:
                words.out.write_text(json.dumps(kept))


if __name__ == "__main__":
    main()
