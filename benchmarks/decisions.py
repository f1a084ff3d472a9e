"""One decision of one robot that chooses among goals, by the side of the arena.

python -m benchmarks.decisions [policy]

A robot on its own: a map that a team of four has half explored, batch 1, one thread. The parts are
the memory, the candidates (in C) and the network. The default policy has untrained weights: they
do not matter here.
"""

from __future__ import annotations

import sys

import torch
from tensordict import TensorDictBase

from benchmarks.timing import medians
from marl_explore import (
    ArenaConfig,
    Caves,
    ExplorationEnv,
    Goals,
    GoalUtility,
    Policy,
    PolicyConfig,
    load_policy,
    play,
)
from marl_explore.transforms.goals import Candidates, find_candidates
from marl_explore.transforms.memory import RememberTeam

SIDES = (12, 32, 64, 128)
EXPLORED = 0.5


def half_explored(side: int) -> TensorDictBase:
    """The observation of a team of four when the largest map has half of the cells."""
    config = ArenaConfig(height=side, width=side)
    arenas = "uniform" if side < 32 else Caves(config)
    env = ExplorationEnv(config, arenas=arenas, terminate_at_coverage=EXPLORED, max_steps=10_000)
    *_, last = play(GoalUtility(config.fov_radius), env, env.max_steps, until_done=True)
    return last


def measure(policy: Policy, sides: tuple[int, ...] = SIDES, repeats: int = 20) -> dict:
    """Median milliseconds of a whole decision of a team of four, and of its parts, by side."""
    results = {}
    for side in sides:
        now = half_explored(side)
        memory = RememberTeam(policy.config.arena.fov_radius)
        known = memory(now.clone())
        found = find_candidates(known)
        actor = policy.actor_of(0)
        rows = Candidates(*(entry.squeeze(0).float() for entry in found))
        with torch.no_grad():
            seconds = medians(
                {
                    "decision": lambda now=now: policy(now.clone(recurse=False)),
                    "memory": lambda now=now, memory=memory: memory(now.clone(recurse=False)),
                    "candidates": lambda known=known: find_candidates(known),
                    "network": lambda rows=rows, actor=actor: actor(*rows),
                },
                repeats,
            )
        results[side] = {part: 1000 * value for part, value in seconds.items()}
    return results


def untrained() -> Policy:
    """An actor with the package's sizes."""
    config = PolicyConfig(ArenaConfig(), Goals(), shared=True)
    return Policy(config, config.make_actors())


def main() -> None:
    torch.set_num_threads(1)
    policy = load_policy(sys.argv[1]) if len(sys.argv) > 1 else untrained()
    print("milliseconds for a team of four; a robot alone decides in at most a whole decision")
    parts = ("decision", "memory", "candidates", "network")
    print(f"{'side':>5}", *(f"{part:>12}" for part in parts), f"{'per robot':>12}")
    for side, row in measure(policy).items():
        print(
            f"{side:>5}", *(f"{row[part]:12.3f}" for part in parts), f"{row['decision'] / 4:12.3f}"
        )


if __name__ == "__main__":
    main()
