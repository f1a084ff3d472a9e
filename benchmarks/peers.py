"""Our ``env.step`` beside environments of other libraries: arena steps per CPU second, in one run.

python -m benchmarks.peers

The tasks differ, so that the numbers tell orders of magnitude: ours computes the sensors, map
merging, frontier table and nearest targets of every robot, and the others what their functions say.
All have 4 agents, random actions, episodes of 200 steps (but VMAS) and, on grids, arenas of our
side. Libraries that are not installed are named and left out; POGEMA takes an old gymnasium, and so
an environment of its own.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import version
from io import StringIO
from itertools import cycle
from typing import Any

import numpy as np
import torch

from benchmarks.environment import EPISODE, ROBOTS, our_step, vmas_step
from benchmarks.timing import conditions, medians
from marl_explore import ArenaConfig

BATCHES = (1, 8, 512, 4096)
JAX_ON_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

Steps = tuple[Callable[[], object], int]
"""A call and how many steps of arenas it makes."""


@dataclass(frozen=True)
class Contender:
    """An environment: its library and how steps of a number of its arenas are made."""

    library: str
    make: Callable[[int], Steps]
    largest: int = max(BATCHES)
    """The most arenas that it is measured with; those that take one arena at a time have 1."""
    gymnasium: str = ""
    """The version of gymnasium without which the library fails."""

    @property
    def needs(self) -> str:
        return self.library + (f" with gymnasium {self.gymnasium}" if self.gymnasium else "")

    def installed(self) -> bool:
        if not version("gymnasium").startswith(self.gymnasium):
            return False
        try:
            with quiet():
                import_module(self.library.lower())
        except ImportError:
            return False
        return True


@contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings, and most greetings, of libraries that are imported."""
    with redirect_stdout(StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def our_episode(num_envs: int) -> Steps:
    """Sensing, map merging, FPR and NET of all robots: new arenas, then an episode's steps."""
    step = our_step(num_envs)

    def episode() -> None:
        for _ in range(EPISODE):
            step()

    return episode, EPISODE * num_envs


def vmas_navigation(num_envs: int) -> Steps:
    """Physics with collisions, and 12 distance rays of each agent; it never restarts."""
    step = vmas_step(num_envs)
    assert step is not None
    return step, num_envs


def jaxmarl_simple_spread(num_envs: int, restart: bool = True) -> Steps:
    """Physics of discs that push each other, and relative positions; compiled, in one scan.

    With ``restart``, each step computes a reset too, as JaxMARL's ``step`` does; without, all
    arenas begin anew together after an episode, as ours do.
    """
    import jax
    import jaxmarl

    env = jaxmarl.make(
        "MPE_simple_spread_v3", num_agents=ROBOTS, num_landmarks=ROBOTS, max_steps=EPISODE
    )
    keys = jax.random.split(jax.random.PRNGKey(0), (EPISODE, num_envs))
    actions = jax.random.randint(jax.random.PRNGKey(1), (EPISODE, num_envs, ROBOTS), 0, 5)
    one_step = jax.vmap(env.step if restart else env.step_env)

    def step(carry: Any, drawn: Any) -> Any:
        state, _, total = carry
        keys, actions = drawn
        named = {agent: actions[:, number] for number, agent in enumerate(env.agents)}
        observations, state, rewards, _, _ = one_step(keys, state, named)
        return (state, observations, total + sum(rewards.values())), None

    def begin(keys: Any) -> Any:
        observations, state = jax.vmap(env.reset)(keys)
        return state, observations, jax.numpy.zeros(num_envs)

    return scanned(begin, step, (keys, actions), num_envs)


def jumanji_cleaner(num_envs: int, restart: bool = True) -> Steps:
    """A grid of tiles known to all, and which moves are valid; compiled, in one scan.

    With ``restart``, each step draws a maze too, as Jumanji's automatic reset does in a batch;
    without, all arenas begin anew together after an episode, as ours do.
    """
    import jax
    import jumanji
    from jumanji.environments.routing.cleaner.generator import RandomGenerator
    from jumanji.wrappers import AutoResetWrapper

    side = ArenaConfig().height
    env = jumanji.make(
        "Cleaner-v0", generator=RandomGenerator(side, side, ROBOTS), time_limit=EPISODE
    )
    keys = jax.random.split(jax.random.PRNGKey(0), (EPISODE, num_envs))
    wishes = jax.random.uniform(jax.random.PRNGKey(1), (EPISODE, num_envs, ROBOTS, 4))
    one_step = jax.vmap((AutoResetWrapper(env) if restart else env).step)

    def step(carry: Any, drawn: Any) -> Any:
        state, observation, total = carry
        _, wishes = drawn
        actions = jax.numpy.where(observation.action_mask, wishes, -1).argmax(-1)
        state, timestep = one_step(state, actions.astype("int32"))
        return (state, timestep.observation, total + timestep.reward), None

    def begin(keys: Any) -> Any:
        state, timestep = jax.vmap(env.reset)(keys)
        return state, timestep.observation, jax.numpy.zeros(num_envs)

    return scanned(begin, step, (keys, wishes), num_envs)


def scanned(
    begin: Callable[[Any], Any], step: Callable[[Any, Any], Any], drawn: Any, num_envs: int
) -> Steps:
    """New arenas and an episode in one compiled call, where each step has its observations.

    The last observations and the rewards are returned: else they would not be computed.
    """
    import jax

    @jax.jit
    def episode(drawn: Any) -> Any:
        return jax.lax.scan(step, begin(drawn[0][0]), drawn)[0]

    return lambda: jax.block_until_ready(episode(drawn)), EPISODE * num_envs


def pogema_grid(num_envs: int) -> Steps:
    """Moves on a grid and three windows of 11 x 11 for each agent, in Python."""
    from pogema import GridConfig, pogema_v0

    side = ArenaConfig().height
    return one_by_one(
        pogema_v0(
            GridConfig(
                num_agents=ROBOTS,
                size=side,
                max_episode_steps=EPISODE,
                on_target="nothing",  # agents stay for the whole episode
                integration="PettingZoo",
            )
        )
    )


def mpe2_simple_spread(num_envs: int) -> Steps:
    """What JaxMARL's ``simple_spread`` computes, in numpy."""
    from mpe2 import simple_spread_v3

    return one_by_one(simple_spread_v3.parallel_env(N=ROBOTS, max_cycles=EPISODE))


def one_by_one(env: Any) -> Steps:
    """One arena with PettingZoo's parallel interface, which begins again when all are done."""
    draw = np.random.default_rng(0)
    counts = {agent: env.action_space(agent).n for agent in env.possible_agents}
    actions = cycle(
        [{agent: int(draw.integers(n)) for agent, n in counts.items()} for _ in range(EPISODE)]
    )
    env.reset()

    def step() -> None:
        if not env.agents:
            env.reset()
        env.step(next(actions))

    return step, 1


CONTENDERS = {
    "ours, FPR and NET": Contender("marl_explore", our_episode),
    "VMAS navigation": Contender("VMAS", vmas_navigation),
    "JaxMARL simple_spread": Contender("JaxMARL", jaxmarl_simple_spread),
    "JaxMARL, reset together": Contender("JaxMARL", partial(jaxmarl_simple_spread, restart=False)),
    "Jumanji Cleaner": Contender("Jumanji", jumanji_cleaner, largest=512),
    "Jumanji, reset together": Contender("Jumanji", partial(jumanji_cleaner, restart=False)),
    "POGEMA": Contender("POGEMA", pogema_grid, largest=1, gymnasium="0.28"),
    "mpe2 simple_spread": Contender("mpe2", mpe2_simple_spread, largest=1),
}


def measure(batches: Sequence[int] = BATCHES, repeats: int = 5) -> dict[str, dict[int, float]]:
    """Arena steps per CPU second of each contender that is installed, by the number of arenas."""
    present = {name: one for name, one in CONTENDERS.items() if one.installed()}
    rates: dict[str, dict[int, float]] = {name: {} for name in present}
    for num_envs in batches:
        with quiet():
            steps = {
                name: contender.make(num_envs)
                for name, contender in present.items()
                if num_envs <= contender.largest
            }
        # of all threads: JAX has threads of its own
        seconds = medians({n: call for n, (call, _) in steps.items()}, repeats, time.process_time)
        for name, (_, count) in steps.items():
            rates[name][num_envs] = count / seconds[name]
    return rates


def report(batches: Sequence[int] = BATCHES, repeats: int = 5) -> list[str]:
    """A line for each contender, with a column per number of arenas, and who is not installed."""
    rates = measure(batches, repeats)
    lines = [f"{'arenas':>24}: " + " ".join(f"{num_envs:>9}" for num_envs in batches)]
    for name, row in rates.items():
        cells = (f"{row[n] / 1e3:9.2f}" if n in row else f"{'-':>9}" for n in batches)
        lines.append(f"{name:>24}: " + " ".join(cells))
    absent = {one.needs: None for name, one in CONTENDERS.items() if name not in rates}
    return lines + [f"{library}: not installed" for library in absent]


def main() -> None:
    parser = argparse.ArgumentParser(description="Arena steps per CPU second.")
    parser.add_argument("--arenas", type=int, nargs="+", default=BATCHES)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    os.environ.setdefault("XLA_FLAGS", JAX_ON_ONE_THREAD)  # before the import of jax
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    print(f"k arena steps per CPU second, {ROBOTS} agents, {conditions()}")
    for line in report(arguments.arenas, arguments.repeats):
        print(line)


if __name__ == "__main__":
    main()
