"""Contacts of robots in the simulated lab with and without locked cells.

python -m benchmarks.locks [policy]   (it takes the extra "lab"; about 4 minutes on one core)

Without locks the rules of the grid still refuse contenders and crossers, but nobody waits for a
cell beside a diagonal and none is held: ``unlocked`` takes the place of ``agree``. Without
clearance a robot drives on whoever is ahead.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from unittest import mock

import torch

from marl_explore import ExplorationEnv, load_policy
from marl_explore.evaluation.episodes import TEST_STREAM
from marl_explore.lab import LabRunner, Noise
from marl_explore.policies.policy import Policy
from marl_explore.robot import agreement, runtime
from marl_explore.robot.agreement import Way

LAYOUTS, STEPS = 20, 60
NOISE = Noise(range_share=0.02, position=0.01, heading=0.0175)
"""As by ``marl-explore lab``."""
ROWS = {
    "locks, clearance": (True, True),
    "locks": (True, False),
    "clearance": (False, True),
    "neither": (False, False),
}


def unlocked(intents: dict[int, runtime.Intent]) -> dict[int, Way]:
    """Every robot's way as if it had the cells beside its diagonal for itself."""
    refused = agreement.contested(intents)
    alone = {robot: agreement.agree({robot: intent}) for robot, intent in intents.items()}
    return {robot: Way(()) if robot in refused else alone[robot][robot] for robot in intents}


def measure(policy: Policy, locks: bool, clearance: bool, layouts: int, steps: int) -> dict:
    """What ``LabRecord.summary`` tells."""
    env = ExplorationEnv(policy.config.arena, layouts, seed=0, stream=TEST_STREAM)
    start = env.reset()
    lab = LabRunner(policy, (start["obstacles"], start["agents", "position"]), NOISE)
    if not clearance:
        for robot in (robot for team in lab.teams for robot in team):
            drive = replace(robot.settings.drive, clearance=0.0)
            robot.settings = replace(robot.settings, drive=drive)
    with mock.patch.object(runtime, "agree", agreement.agree if locks else unlocked):
        return lab.run(steps).summary()


def main() -> None:
    torch.set_num_threads(1)
    policy = load_policy(sys.argv[1] if len(sys.argv) > 1 else "paper-cnn-case2")
    print(f"{LAYOUTS} labs, {STEPS} steps", flush=True)
    columns = ("robot contacts", "obstacle contacts", "agreement", "seconds of a step")
    print(f"{'':>18}" + "".join(f"{name:>20}" for name in columns))
    for name, (locks, clearance) in ROWS.items():
        result = measure(policy, locks, clearance, LAYOUTS, STEPS)
        print(f"{name:>18}" + "".join(f"{result[c]:20.4g}" for c in columns), flush=True)


if __name__ == "__main__":
    main()
