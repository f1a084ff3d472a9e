"""One decision of one robot that chooses among goals, by the side of the arena.

python -m benchmarks.decisions [policy]

Maps that a team of four has half explored, batch 1, one thread: the whole team with torch, and one
of its robots alone in numpy, as an exported policy. The parts are the memory, the candidates (in C)
and the network; in numpy memory and candidates are one. The default policy has untrained weights:
they do not matter here.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase

from benchmarks.timing import medians
from marl_explore import (
    ArenaConfig,
    Caves,
    ExplorationEnv,
    ExportedPolicy,
    Goals,
    GoalUtility,
    Policy,
    PolicyConfig,
    export_npz,
    load_policy,
    play,
)
from marl_explore.policies.export import robot_observation
from marl_explore.transforms.goals import Candidates, find_candidates
from marl_explore.transforms.memory import RememberTeam

SIDES = (12, 32, 64, 128)
EXPLORED = 0.5


def half_explored(side: int) -> TensorDictBase:
    """The observation of a team of four when the largest map has half of the cells."""
    config = ArenaConfig(height=side, width=side)
    arenas = "uniform" if side < 32 else Caves(config)
    env = ExplorationEnv(config, arenas=arenas, terminate_at_coverage=EXPLORED, max_steps=10_000)
    *_, last = play(GoalUtility(config.sight), env, env.max_steps, until_done=True)
    return last


def measure(policy: Policy, sides: tuple[int, ...] = SIDES, repeats: int = 20) -> dict:
    """Median milliseconds of decisions and of their parts, with torch and in numpy, by side."""
    results = {}
    for side in sides:
        now = half_explored(side)
        alone = _robot(policy, now)
        sight = policy.config.arena.sight
        memory = RememberTeam(sight=sight)
        known = memory(now.clone())
        found = find_candidates(known, sight)
        actor = policy.actor_of(0)
        rows = Candidates(*(entry.squeeze(0).float() for entry in found))
        with torch.no_grad():
            seconds = medians(
                {
                    "decision": lambda now=now: policy(now.clone(recurse=False)),
                    "memory": lambda now=now, memory=memory: memory(now.clone(recurse=False)),
                    "candidates": lambda known=known, sight=sight: find_candidates(known, sight),
                    "network": lambda rows=rows, actor=actor: actor(*rows),
                    **alone,
                },
                repeats,
            )
        results[side] = {part: 1000 * value for part, value in seconds.items()}
    return results


def _robot(policy: Policy, now: TensorDictBase) -> dict[str, Callable[[], object]]:
    """A decision of robot 0 in numpy, and its parts."""
    with tempfile.TemporaryDirectory() as folder:
        robot = ExportedPolicy(export_npz(policy, Path(folder) / "policy.npz"), 0, sample=False)
    seen = robot_observation(now, 0, 0)
    robot(seen)
    goals = robot._goals
    found = goals._episode.find(seen)
    return {
        "robot": lambda: robot(seen),
        "its candidates": lambda: goals._episode.find(seen),
        "its network": lambda: goals.network(found),
    }


def untrained() -> Policy:
    """An actor with the package's sizes."""
    config = PolicyConfig(ArenaConfig(), Goals(), shared=True)
    return Policy(config, config.make_actors())


def main() -> None:
    torch.set_num_threads(1)
    policy = load_policy(sys.argv[1]) if len(sys.argv) > 1 else untrained()
    print("milliseconds: a team of four with torch, then one of its robots in numpy")
    for number, (side, row) in enumerate(measure(policy).items()):
        if not number:
            print(f"{'side':>5}", *(f"{part:>15}" for part in row))
        print(f"{side:>5}", *(f"{milliseconds:15.3f}" for milliseconds in row.values()))


if __name__ == "__main__":
    main()
