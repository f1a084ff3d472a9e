"""A whole training iteration, split into its parts, against bare matrix products in one run.

python -m benchmarks.training
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import torch

from benchmarks.timing import conditions, medians
from marl_explore.policies.networks import MLP, OBSERVATION_KEYS
from marl_explore.training.config import TrainConfig
from marl_explore.training.presets import PRESETS
from marl_explore.training.trainer import Trainer

Product = tuple[int, int, int]


def products(hidden: Sequence[int], widths: tuple[int, ...], rows: int) -> list[Product]:
    """The forward products (rows, inputs, outputs) of an MLP on a batch."""
    layers = (*widths[:1], *hidden, *widths[1:])
    return [(rows, a, b) for a, b in pairwise(layers)]


def with_gradients(forward: list[Product]) -> list[Product]:
    """And those of the backward pass: for the weights of all layers, the inputs of all but one."""
    weights = [(a, rows, b) for rows, a, b in forward]
    inputs = [(rows, b, a) for rows, a, b in forward[1:]]
    return [*forward, *weights, *inputs]


def iteration_products(config: TrainConfig) -> list[Product]:
    """All matrix products of one iteration with MLPs on the joint observation."""
    assert isinstance(config.network, MLP)
    arena, batch, hidden = config.arena, config.batch_frames, config.network.hidden
    robots, size = arena.num_agents, arena.observation_size
    actor, critic = (size, 10), (robots * size, 1)
    acting = products(hidden, actor, config.num_envs) * config.rollout_steps * robots
    values = products(hidden, critic, batch + config.num_envs)  # shared by neighbouring steps
    factors = products(hidden, actor, batch) * (robots - 1)
    actors = with_gradients(products(hidden, actor, batch)) * config.ppo_epochs * robots
    critics = with_gradients(products(hidden, critic, batch)) * config.ppo_epochs
    return acting + values + factors + actors + critics


def multiply(shapes: list[Product]) -> Callable[[], None]:
    """Bare ``torch.mm`` of all shapes."""
    left = {(n, k): torch.randn(n, k) for n, k, _ in shapes}
    right = {(k, m): torch.randn(k, m) for _, k, m in shapes}
    out = {(n, m): torch.empty(n, m) for n, _, m in shapes}

    def run() -> None:
        for n, k, m in shapes:
            torch.mm(left[n, k], right[k, m], out=out[n, m])

    return run


class Iteration:
    """One iteration of a run at a time, with the time its parts took."""

    def __init__(self, config: TrainConfig) -> None:
        self.trainer = Trainer(config)
        self.seconds: dict[str, list[float]] = {"collection": [], "update": []}

    def __call__(self) -> None:
        start = time.perf_counter()
        (batch,) = self.trainer.collect()
        collected = time.perf_counter()
        self.trainer.update(batch)
        self.seconds["collection"].append(collected - start)
        self.seconds["update"].append(time.perf_counter() - collected)

    def acting(self) -> Callable[[], object]:
        """The actors' networks alone, as often as one iteration needs them."""
        config = self.trainer.config
        observation = self.trainer.collect()[0][:, 0]
        inputs = [observation[key].contiguous() for key in OBSERVATION_KEYS]

        @torch.no_grad()
        def run() -> None:
            stacked = self.trainer.policy.team.stacked
            with stacked.together():
                for _ in range(config.rollout_steps):
                    stacked(*inputs)

        return run


def measure(preset: str, repeats: int = 7, **changes: object) -> dict[str, float]:
    """Median seconds of a whole iteration and of its parts, and of bare products."""
    config = replace(PRESETS[preset], **changes)
    iteration = Iteration(config)
    contenders: dict[str, Callable[[], object]] = {
        "iteration": iteration,
        "networks while acting": iteration.acting(),
    }
    if isinstance(config.network, MLP) and config.critic_input == "observation":
        contenders["bare products"] = multiply(iteration_products(config))
    seconds = medians(contenders, repeats)
    for part, values in iteration.seconds.items():
        seconds[part] = statistics.median(values[1:])
    seconds["environment and TorchRL"] = seconds["collection"] - seconds["networks while acting"]
    iteration.trainer.rollouts.close()
    return seconds


def main() -> None:
    torch.set_num_threads(1)
    for preset in ("paper-mlp-case2", "fast"):
        seconds = measure(preset)
        whole = seconds["iteration"]
        print(f"one iteration of {preset}, {conditions()}")
        for name, value in seconds.items():
            print(f"{name:>24}: {value:8.3f} s {value / whole:7.1%} of the iteration")
        if "bare products" in seconds:
            print(f"an iteration takes {whole / seconds['bare products']:.2f} x its bare products")


if __name__ == "__main__":
    main()
