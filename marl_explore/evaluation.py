"""Policies on arenas they never saw: record episodes, measure them, put them in a table."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import step_mdp

from marl_explore import tables
from marl_explore.arenas import Generator, default_steps
from marl_explore.config import ArenaConfig, require_integer
from marl_explore.core.mapping import known_mask, target_cells, union_of
from marl_explore.env import ExplorationEnv
from marl_explore.files import whole_file, write_text
from marl_explore.likeliest import LikeliestActions
from marl_explore.metrics import Episodes, Snapshot, snapshot, summarize
from marl_explore.planners import PLANNERS
from marl_explore.policies import load_policy, policy_info

Actor = Callable[[TensorDictBase], TensorDictBase]

TEST_STREAM = "test"
ARGMAX = ":argmax"
EVENTS = ("dangerous", "merged", "discovered", "received")


def find_policy(name: str, config: ArenaConfig) -> Actor:
    """A planner's name, or what ``load_policy`` takes, ready to act on arenas of ``config``.

    Policies draw their actions; with ":argmax" after its name one takes the likeliest
    (``LikeliestActions``).

    Raises:
        ValueError: naming what there is, for an unknown name.
    """
    if name in PLANNERS:
        return PLANNERS[name](config)
    likeliest = name.endswith(ARGMAX)
    try:
        policy = load_policy(name.removesuffix(ARGMAX))
    except ValueError as error:
        raise ValueError(f"{error}; planners: {sorted(PLANNERS)}") from error
    policy.check(config.num_agents, config.fov_size)
    policy.use_range(config.communication_cells)
    return LikeliestActions(policy) if likeliest else policy


def training_arenas(name: str) -> tuple[ArenaConfig, str]:
    """The arena and the kind of arenas (such as a suite's name) a policy was trained on.

    Raises:
        ValueError: saying why, for what is no policy, such as a planner's name.
    """
    name = name.removesuffix(ARGMAX)
    arena = load_policy(name).spec.arena
    return arena, policy_info(name).get("config", {}).get("arenas", "uniform")


def trained_on(name: str) -> tuple[ArenaConfig, str] | None:
    """The ``training_arenas`` of a policy; None for what is none."""
    try:
        return training_arenas(name)
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
    config: ArenaConfig | None,
    arena_index: int = 0,
    steps: int | None = None,
    seed: int = 0,
    stream: str = TEST_STREAM,
    arenas: str | Generator = "uniform",
) -> list[TensorDictBase]:
    """The observations of one arena's episode until a robot's map is complete, batch [1].

    Deterministic given the seed; for figures and replays.

    Args:
        policy: TensorDict in, action out.
        config: arena and robots; None: those that ``arenas`` brings.
        arena_index: which arena of the stream; row i of ``record`` is arena i.
        steps: most steps to take; None: the suite's, or 300.
        seed: of the arena and of sampled actions; the global random state is left as it was.
        stream: family of arenas.
        arenas: a suite's name or a generator, as for ``ExplorationEnv``.
    """
    steps = default_steps(arenas) if steps is None else steps
    require_integer("arena_index", arena_index, 0)
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    shared = getattr(policy, "shares_maps", False)
    env = ExplorationEnv(
        config,
        max_steps=steps,
        terminate_at_coverage=None if shared else 1.0,
        arenas=arenas,
        seed=seed,
        stream=stream,
        first_arena=arena_index,
    )
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        episode = play(policy, env, steps, until_done=True)
        return list(_until_shared(episode) if shared else episode)


def _until_shared(episode: Iterator[TensorDictBase]) -> Iterator[TensorDictBase]:
    """The observations with the union as the map of every robot, until it is complete."""
    target: Tensor | None = None
    for observation in episode:
        maps = _measured(observation, shared=True).contiguous()
        if target is None:
            target = target_cells(observation["obstacles"], observation["agents", "position"])
        observation["agents"] = observation["agents"].copy().set("map", maps)
        yield observation
        if (known_mask(maps[:, 0]) >= target).all():
            return


def _measured(observation: TensorDictBase, shared: bool) -> Tensor:
    """The robots' maps [B, N, H, W]; of a reference that shares them, their union for each."""
    grid = observation["agents", "map"]
    return union_of(grid).unsqueeze(-3).expand_as(grid) if shared else grid


def record(
    policy: Actor,
    config: ArenaConfig | None,
    num_arenas: int = 200,
    steps: int | None = None,
    seed: int = 0,
    stream: str = TEST_STREAM,
    arenas: str | Generator = "uniform",
) -> Episodes:
    """Run a policy once on every arena, deterministic given the seed.

    Args:
        policy: TensorDict in, action out.
        config: arenas and robots; None: those that ``arenas`` brings.
        num_arenas: B.
        steps: T; None: the suite's, or 300.
        seed: of the arenas and of sampled actions; the global random state is left as it was.
        stream: family of arenas.
        arenas: a suite's name or a generator, as for ``ExplorationEnv``.
    """
    steps = default_steps(arenas) if steps is None else steps
    require_integer("num_arenas", num_arenas, 1)
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    env = ExplorationEnv(
        config, num_arenas, max_steps=steps, arenas=arenas, seed=seed, stream=stream
    )
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        episode = play(policy, env, steps)
        start = next(episode)
        target = target_cells(start["obstacles"], start["agents", "position"])
        shared = getattr(policy, "shares_maps", False)
        maps = [snapshot(_measured(start, shared), target)]
        events = {key: [start["agents", key]] for key in EVENTS}
        actions = []
        for observation in episode:
            agents = observation["agents"]
            maps.append(snapshot(_measured(observation, shared), target))
            actions.append(agents["action"])
            for key, values in events.items():
                values.append(agents[key])
    return Episodes(
        maps=Snapshot(*(torch.stack(entry, 1) for entry in zip(*maps, strict=True))),
        action=torch.stack(actions, 1),
        **{key: torch.stack(values, 1) for key, values in events.items()},
        num_targets=target.flatten(-2).sum(-1),
        num_cells=env.config.num_cells,
        cell_size=env.config.cell_size,
        max_discovery=env.config.max_discovery,
    )


def evaluate(policy: Actor, config: ArenaConfig | None, **options: Any) -> dict[str, float]:
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
    rows = [
        [name, *(tables.number(measures[key]) for key in columns.values())]
        for name, measures in results.items()
    ]
    return tables.text(["policy", *columns], rows)


def write_results(
    folder: Path,
    results: dict[str, dict[str, float]],
    record: dict[str, Any],
    scores: Mapping[str, Mapping[str, Tensor]] | None = None,
) -> None:
    """Write every measure as results.json and results.csv, and the main ones as table.txt.

    Args:
        folder: where.
        results: by policy and measure.
        record: about the run, kept in results.json.
        scores: by policy and measure the numbers of every arena [B], kept in results.json.
    """
    measures = {n: {k: v if v == v else None for k, v in r.items()} for n, r in results.items()}
    content: dict[str, Any] = {"results": measures, "run": record}
    if scores is not None:
        content["scores"] = {
            name: {key: values.tolist() for key, values in of_policy.items()}
            for name, of_policy in scores.items()
        }
    write_text(folder / "results.json", json.dumps(content, indent=2, default=str) + "\n")
    write_text(folder / "table.txt", format_table(results) + "\n")
    with whole_file(folder / "results.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        names = list(next(iter(results.values())))
        writer.writerow(["policy", *names])
        writer.writerows([policy, *(row[n] for n in names)] for policy, row in results.items())
