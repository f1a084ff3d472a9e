"""Episodes of policies on unseen arenas: played, watched, recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import step_mdp

from marl_explore.arenas import Generator, default_config, default_steps, in_order
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.core.links import any_linked
from marl_explore.core.mapping import (
    finishable,
    known_mask,
    known_targets,
    target_cells,
    union_of,
)
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.envs.memory import require_env_memory
from marl_explore.evaluation.metrics import Episodes, Snapshot, snapshot
from marl_explore.utils.devices import CPU, find_device, keep_random_state
from marl_explore.utils.memory import require_memory

Actor = Callable[[TensorDictBase], TensorDictBase]

TEST_STREAM = "test"
BYTES_PER_STEP = 60
"""Of a robot's step in ``Episodes``."""
EVENTS = ("position", "dangerous", "merged", "discovered", "received", "alive")


def play(
    policy: Actor, env: ExplorationEnv, steps: int, until_done: bool = False
) -> Iterator[TensorDictBase]:
    """The observations of an episode, starting with that of the reset.

    Each later one also holds the ("agents", "action") that led to it.

    Args:
        policy: TensorDict in, action out; a trained one that works with any sensors is told those
            of ``env``.
        env: reset once by this function, at the start.
        steps: maximum number of steps.
        until_done: whether to stop when every arena is done.
    """
    # not by its class: what planners do does not depend on the modules of trained policies
    if (in_world := getattr(policy, "in_world", None)) is not None:
        policy = in_world(env.config)
    observation = env.reset()
    yield observation
    for _ in range(steps):
        # a copy, so that the action is not written into the observation that was yielded
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
        arena_index: index of the arena in the stream; row i of ``record`` is arena i.
        config, steps, seed, stream, arenas: as for ``record``.
    """
    require_integer("arena_index", arena_index, 0)
    shared = getattr(policy, "shares_maps", False)
    task: dict[str, Any] = {
        "first_arena": arena_index,
        "terminate_at_coverage": None if shared else 1.0,
    }
    with _test_env(config, steps, seed, stream, arenas, **task) as env:
        episode = play(policy, env, env.max_steps, until_done=True)
        return list(_until_shared(episode) if shared else episode)


@contextmanager
def _test_env(
    config: ArenaConfig | None,
    steps: int | None,
    seed: int,
    stream: str,
    arenas: str | Generator,
    device: torch.device = CPU,
    **task: Any,
) -> Iterator[ExplorationEnv]:
    """Test arenas, without gradients; random numbers in this context follow from the seed."""
    steps = default_steps(arenas) if steps is None else steps
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    config = default_config(arenas) if config is None else config
    arenas = in_order(arenas, config)
    env = ExplorationEnv(
        config, max_steps=steps, arenas=arenas, seed=seed, stream=stream, device=device, **task
    )
    with keep_random_state(device), torch.no_grad():
        torch.manual_seed(seed)
        yield env


def _until_shared(episode: Iterator[TensorDictBase]) -> Iterator[TensorDictBase]:
    """The observations with the union as every robot's map, until it is complete."""
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
    """The robots' maps [B, N, H, W]; for a reference that shares them, their union for each."""
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
    device: str = "cpu",
) -> Episodes:
    """Run a policy once on every arena, deterministic given the seed.

    Args:
        policy: TensorDict in, action out.
        config: arenas and robots; None: the default of ``arenas``.
        num_arenas: B.
        steps: T; None: the suite's, or 300.
        seed: of the arenas and of sampled actions; the global random state is restored.
        stream: family of arenas.
        arenas: a suite's name or a generator, as for ``ExplorationEnv``.
        device: where arenas are stepped and the policy acts, which is moved there; sampled actions
            depend on it.

    Returns:
        Tensors on the CPU.

    Raises:
        ValueError: for a setting that is not allowed, or a device that this machine has not.
    """
    steps = default_steps(arenas) if steps is None else steps
    require_recording(config or default_config(arenas), num_arenas, steps)
    place = find_device(device)
    if (move := getattr(policy, "to", None)) is not None:
        policy = move(place)
    with _test_env(config, steps, seed, stream, arenas, place, num_envs=num_arenas) as env:
        shared = getattr(policy, "shares_maps", False)
        return measure_steps(play(policy, env, env.max_steps), env.config, shared).cpu()


def require_recording(config: ArenaConfig, num_arenas: int, steps: int) -> None:
    """Raise an error for episodes that ``record`` could not hold on this machine.

    Raises:
        ValueError: naming the setting that is not allowed, or those that need the memory.
    """
    require_integer("num_arenas", num_arenas, 1)
    require_integer("steps", steps, 1)
    require_env_memory(config, num_arenas)
    counts = BYTES_PER_STEP * config.num_agents * num_arenas * steps
    require_memory(f"num_arenas={num_arenas} x steps={steps}", counts)


def measure_steps(
    observations: Iterable[TensorDictBase], config: ArenaConfig, shared: bool = False
) -> Episodes:
    """What metrics need of the observations of episodes, the reset's first.

    Args:
        observations: batch [B] each, as ``play`` and ``watch`` give them.
        config: of the arenas.
        shared: whether all robots count as having the union of the maps.
    """
    episode = iter(observations)
    start = next(episode)
    target = target_cells(start["obstacles"], start["agents", "position"])
    maps: list[Snapshot] = []
    events: dict[str, list[Tensor]] = {key: [] for key in (*EVENTS, "linked")}
    actions = []
    for observation in chain((start,), episode):
        agents, grid = observation["agents"], _measured(observation, shared)
        alive = agents["alive"]
        maps.append(snapshot(grid, target, alive))
        if observation is not start:
            actions.append(agents["action"])
        for key in EVENTS:
            events[key].append(agents[key])
        events["linked"].append(any_linked(agents["linked"]))
    knowing = known_targets(known_mask(union_of(grid).unsqueeze(-3)), target).squeeze(-1)
    return Episodes(
        maps=Snapshot(*(torch.stack(entry, 1) for entry in zip(*maps, strict=True))),
        action=torch.stack(actions, 1),
        **{key: torch.stack(values, 1) for key, values in events.items()},
        num_targets=target.flatten(-2).sum(-1),
        finishable=finishable(start["obstacles"], agents["position"], alive, grid, target),
        lost_targets=knowing - maps[-1].union_targets,
        num_cells=config.num_cells,
        cell_size=config.cell_size,
        max_discovery=config.max_discovery,
    )
