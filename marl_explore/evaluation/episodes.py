"""Episodes of policies on unseen arenas: played, watched, recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import step_mdp

from marl_explore.arenas import Generator, default_config, default_steps, in_order
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.core.mapping import known_mask, target_cells
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.envs.memory import require_env_memory
from marl_explore.evaluation.metrics import Episodes
from marl_explore.evaluation.recording import Recording, maps_that_count
from marl_explore.utils.devices import CPU, find_device, keep_random_state
from marl_explore.utils.memory import require_memory

Actor = Callable[[TensorDictBase], TensorDictBase]

TEST_STREAM = "test"
BYTES_PER_STEP = 60
"""Of a robot's step in ``Episodes``."""
FEW = 0.75
"""Share of the arenas of a batch that must be left for it to be stepped as it is."""


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
    act, observation = _told_of(env, policy), env.reset()
    yield observation
    for _ in range(steps):
        observation = _step(act, env, observation)
        yield observation
        if until_done and observation["done"].all():
            return


def _told_of(env: ExplorationEnv, policy: Actor) -> Actor:
    """The policy for the sensors of an environment, if it works with any."""
    # not by its class: what planners do does not depend on the modules of trained policies
    in_world = getattr(policy, "in_world", None)
    return policy if in_world is None else in_world(env.config)


def _step(policy: Actor, env: ExplorationEnv, observation: TensorDictBase) -> TensorDictBase:
    """The next observation, with the action that led to it."""
    # a copy, so that the action is not written into the observation
    stepped = env.step(policy(observation.clone(recurse=False)))
    return step_mdp(stepped, exclude_action=False)


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
        maps = maps_that_count(observation, shared=True).contiguous()
        if target is None:
            target = target_cells(observation["obstacles"], observation["agents", "position"])
        observation["agents"] = observation["agents"].copy().set("map", maps)
        yield observation
        if (known_mask(maps[:, 0]) >= target).all():
            return


def record(
    policy: Actor,
    config: ArenaConfig | None,
    num_arenas: int = 200,
    steps: int | None = None,
    seed: int = 0,
    stream: str = TEST_STREAM,
    arenas: str | Generator = "uniform",
    device: str = "cpu",
    until_mapped: bool = False,
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
        until_mapped: whether an episode ends as soon as the map of every living robot is complete.
            Arenas whose episodes are over are not stepped any more, which is several times faster;
            sampled actions of the others depend on that. A policy that remembers arenas by their
            places in the batch needs methods ``only``, as ``Planner`` and ``RememberTeam`` have, or
            ``whole_batch = True``, with which all are stepped until the last is over.

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
        act, observation = _told_of(env, policy), env.reset()
        shared = getattr(policy, "shares_maps", False)
        recording = Recording(env.config, observation, shared, until_mapped)
        for _ in range(steps):
            observation = _step(act, env, observation)
            recording.add(observation)
            going = recording.going_on()
            if not len(going):
                break
            if len(going) <= FEW * env.num_envs and not getattr(act, "whole_batch", False):
                recording.only(going)
                _forget_others(act, going)
                env, observation = _some(env, going), observation[going]
        return recording.episodes(steps).cpu()


def _forget_others(policy: Actor, arenas: Tensor) -> None:
    """Tell the parts of a policy that remember a batch which of its arenas are left, int64 [b]."""
    parts = policy.modules() if isinstance(policy, nn.Module) else [policy]
    for part in parts:
        if hasattr(type(part), "only"):  # not what a wrapper passes on: its parts are asked too
            part.only(arenas)  # type: ignore[attr-defined]


def _some(env: ExplorationEnv, arenas: Tensor) -> ExplorationEnv:
    """An environment that goes on with some of the arenas of another, int64 [b]."""
    state = {key: x[arenas] if isinstance(x, Tensor) else x for key, x in env.state_dict().items()}
    fewer = ExplorationEnv(
        env.config, len(arenas), max_steps=env.max_steps, seed=int(state["seed"]), device=env.device
    )
    fewer.load_state_dict(state)
    return fewer


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


def measure_steps(observations: Iterable[TensorDictBase], config: ArenaConfig) -> Episodes:
    """What metrics need of the observations of episodes, the reset's first.

    Args:
        observations: batch [B] each, as ``play`` and ``watch`` give them.
        config: of the arenas.
    """
    episode = iter(observations)
    recording = Recording(config, next(episode))
    for observation in episode:
        recording.add(observation)
    return recording.episodes()
