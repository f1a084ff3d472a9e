"""Our ``env.step`` with FPR and NET against VMAS and a PettingZoo-style environment, in one run.

python -m benchmarks.environment
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import cycle

import torch

from benchmarks.baselines import PythonExploration
from benchmarks.timing import conditions, medians
from marl_explore import ArenaConfig, make_env
from marl_explore.planners import PLANNERS
from marl_explore.training.collectors import make_collector
from marl_explore.training.config import TrainConfig
from marl_explore.training.environment import make_training_env

ROBOTS = 4
EPISODE = 200
"""Steps after which new episodes begin, as in training."""


def our_step(num_envs: int, backend: str = "auto"):
    """One step of all arenas with random actions drawn before."""
    env = make_env(ArenaConfig(num_agents=ROBOTS), num_envs, max_steps=10**9, backend=backend)
    actions = [env.full_action_spec.rand() for _ in range(EPISODE)]

    def step(number: int):
        if number == 0:
            env.reset()
        env.step(actions[number].clone(recurse=False))

    return in_episodes(step)


def in_episodes(step: Callable[[int], object]) -> Callable[[], object]:
    """Calls with 0, 1, ... and again from 0: maps must not be complete for most of the time."""
    numbers = cycle(range(EPISODE))
    return lambda: step(next(numbers))


def collector_step(num_envs: int, steps: int):
    """A batch of a TorchRL collector with the random walk as its policy."""
    config = ArenaConfig(num_agents=ROBOTS)
    collector = make_collector(
        partial(make_training_env, TrainConfig(config, episode_steps=EPISODE)),
        PLANNERS["random"](config),
        num_envs=num_envs,
        steps=steps,
    )
    batches = iter(collector)
    return lambda: next(batches)


def vmas_step(num_envs: int):
    """One step of VMAS's ``navigation`` with as many agents; None where VMAS is not installed."""
    try:
        import vmas
    except ImportError:
        return None
    env = vmas.make_env("navigation", num_envs, device="cpu", n_agents=ROBOTS, seed=0)
    env.reset()
    actions = [torch.rand(num_envs, 2) * 2 - 1 for _ in range(ROBOTS)]
    return lambda: env.step(actions)


def python_step():
    """One step of the same task as plain Python with one A* per frontier, a single arena."""
    env = PythonExploration(seed=0)

    def step(number: int):
        if number == 0:
            env.reset()
        return env.step()

    return in_episodes(step)


def measure(num_envs: int = 512, repeats: int = 30) -> dict[str, float]:
    """Robot-steps per second of each contender."""
    batch = 10
    contenders = {
        "ours, auto": (our_step(num_envs), num_envs),
        "ours, torch": (our_step(num_envs, "torch"), num_envs),
        "collector": (collector_step(num_envs, batch), num_envs * batch),
        "PettingZoo-style Python": (python_step(), 1),
    }
    if (step := vmas_step(num_envs)) is not None:
        contenders["VMAS navigation"] = (step, num_envs)
    seconds = medians({name: step for name, (step, _) in contenders.items()}, repeats)
    return {name: ROBOTS * count / seconds[name] for name, (_, count) in contenders.items()}


def main() -> None:
    torch.set_num_threads(1)
    rates = measure()
    ours = rates["ours, auto"]
    print(f"env.step, 512 arenas x {ROBOTS} robots, {conditions()}")
    for name, rate in rates.items():
        print(f"{name:>24}: {rate / 1e3:10.1f} k robot-steps/s, ours is {ours / rate:7.2f} x")


if __name__ == "__main__":
    main()
