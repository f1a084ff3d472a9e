"""Policies on arenas they never saw: record episodes, measure them, put them in a table."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import step_mdp

from marl_explore.config import ArenaConfig, require_integer
from marl_explore.core.mapping import target_cells
from marl_explore.env import ExplorationEnv
from marl_explore.metrics import Episodes, Snapshot, snapshot, summarize
from marl_explore.planners import PLANNERS
from marl_explore.policies import load_policy

Actor = Callable[[TensorDictBase], TensorDictBase]

TEST_STREAM = "test"
EVENTS = ("dangerous", "merged", "discovered", "received")


def find_policy(name: str, config: ArenaConfig) -> Actor:
    """A planner's name, or what ``load_policy`` takes, ready to act on arenas of ``config``.

    Raises:
        ValueError: naming what there is, for an unknown name.
    """
    if name in PLANNERS:
        return PLANNERS[name](config)
    try:
        policy = load_policy(name)
    except ValueError as error:
        raise ValueError(f"{error}; planners: {sorted(PLANNERS)}") from error
    policy.check(config.num_agents, config.fov_size)
    policy.use_range(config.communication_cells)
    return policy


def trained_arena(name: str) -> ArenaConfig | None:
    """The arena a policy was trained on; None for what is no policy, such as a planner's name."""
    try:
        return load_policy(name).spec.arena
    except ValueError:
        return None


def play(
    policy: Actor, env: ExplorationEnv, steps: int, until_done: bool = False
) -> Iterator[TensorDictBase]:
    """The observations of an episode, the reset's first.

    Each later one also holds the ("agents", "action") that led to it.

    Args:
        policy: TensorDict in, action out.
        env: reset by this function, never in between.
        steps: most steps to take.
        until_done: whether to stop when every arena is done.
    """
    observation = env.reset()
    yield observation
    for _ in range(steps):
        # a copy, so that the action is not written into the observation that was handed out
        stepped = env.step(policy(observation.clone(recurse=False)))
        observation = step_mdp(stepped, exclude_action=False)
        yield observation
        if until_done and observation["done"].all():
            return


def watch(
    policy: Actor,
    config: ArenaConfig,
    arena_index: int = 0,
    steps: int = 300,
    seed: int = 0,
    stream: str = TEST_STREAM,
) -> list[TensorDictBase]:
    """The observations of one arena's episode until a robot's map is complete, batch [1].

    Deterministic given the seed; for figures and replays.

    Args:
        policy: TensorDict in, action out.
        config: arena and robots.
        arena_index: which arena of the stream; row i of ``record`` is arena i.
        steps: most steps to take.
        seed: of the arena and of sampled actions; the global random state is left as it was.
        stream: family of arenas.
    """
    require_integer("arena_index", arena_index, 0)
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    env = ExplorationEnv(
        config,
        max_steps=steps,
        terminate_at_coverage=1.0,
        seed=seed,
        stream=stream,
        first_arena=arena_index,
    )
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        return list(play(policy, env, steps, until_done=True))


def record(
    policy: Actor,
    config: ArenaConfig,
    num_arenas: int = 200,
    steps: int = 300,
    seed: int = 0,
    stream: str = TEST_STREAM,
) -> Episodes:
    """Run a policy once on every arena, deterministic given the seed.

    Args:
        policy: TensorDict in, action out.
        config: arenas and robots.
        num_arenas: B.
        steps: T.
        seed: of the arenas and of sampled actions; the global random state is left as it was.
        stream: family of arenas.
    """
    require_integer("num_arenas", num_arenas, 1)
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    env = ExplorationEnv(config, num_arenas, max_steps=steps, seed=seed, stream=stream)
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        episode = play(policy, env, steps)
        start = next(episode)
        target = target_cells(start["obstacles"], start["agents", "position"])
        maps = [snapshot(start["agents", "map"], target)]
        events = {key: [start["agents", key]] for key in EVENTS}
        actions = []
        for observation in episode:
            agents = observation["agents"]
            maps.append(snapshot(agents["map"], target))
            actions.append(agents["action"])
            for key, values in events.items():
                values.append(agents[key])
    return Episodes(
        maps=Snapshot(*(torch.stack(entry, 1) for entry in zip(*maps, strict=True))),
        action=torch.stack(actions, 1),
        **{key: torch.stack(values, 1) for key, values in events.items()},
        num_targets=target.flatten(-2).sum(-1),
        num_cells=config.num_cells,
        cell_size=config.cell_size,
        max_discovery=config.max_discovery,
    )


def evaluate(policy: Actor, config: ArenaConfig, **options: Any) -> dict[str, float]:
    """The measures of ``metrics.summarize`` for one policy; options as for ``record``."""
    return summarize(record(policy, config, **options))


TABLE_COLUMNS = {
    "steps to 95 %": "steps_to_95",
    "steps to 100 %": "steps_to_100",
    "complete": "complete",
    "coverage at 50": "coverage_at_50",
    "coverage at 150": "coverage_at_150",
    "communicate": "communication_share",
    "useful": "useful_share",
    "overlap": "overlap",
}
"""Columns of the printed table; files hold every measure."""


def format_table(results: dict[str, dict[str, float]]) -> str:
    """A text table of policies by their main measures."""
    columns = {
        title: key
        for title, key in TABLE_COLUMNS.items()
        if all(key in row for row in results.values())
    }
    rows = [["policy", *columns]]
    for name, measures in results.items():
        rows.append([name, *(_format(measures[key]) for key in columns.values())])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]
    return "\n".join([lines[0], "  ".join("-" * w for w in widths), *lines[1:]])


def _format(value: float) -> str:
    if value != value:  # NaN: nothing happened that could be measured
        return "-"
    return f"{value:.1f}" if abs(value) >= 2 else f"{value:.3f}"


def write_results(
    folder: Path, results: dict[str, dict[str, float]], record: dict[str, Any]
) -> None:
    """Write every measure as results.json and results.csv, and the main ones as table.txt."""
    measures = {n: {k: v if v == v else None for k, v in r.items()} for n, r in results.items()}
    (folder / "results.json").write_text(
        json.dumps({"results": measures, "run": record}, indent=2, default=str) + "\n"
    )
    (folder / "table.txt").write_text(format_table(results) + "\n")
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        names = list(next(iter(results.values())))
        writer.writerow(["policy", *names])
        writer.writerows([policy, *(row[n] for n in names)] for policy, row in results.items())
