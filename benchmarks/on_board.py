"""One decision of a robot, as it makes it on board: with the C kernels, and with numpy alone.

python -m benchmarks.on_board

Robot 0 of a team of four, with the map and the memory of an episode in which the largest map has
half of the cells; batch 1, one thread. The actor's weights are untrained: they do not matter here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from benchmarks.decisions import EXPLORED, untrained
from benchmarks.timing import medians
from marl_explore import (
    ArenaConfig,
    Caves,
    ExplorationEnv,
    ExportedPolicy,
    GoalUtility,
    Mazes,
    export_npz,
    play,
)
from marl_explore.core import native
from marl_explore.policies.export import robot_observation
from marl_explore.robot.observation import Observation
from marl_explore.robot.planners import PLANNERS

SIDE = 64
KINDS = {"caves": Caves, "mazes": Mazes}


@contextmanager
def numpy_alone() -> Iterator[None]:
    """Without the C kernels."""
    missing = native.missing
    native.missing = lambda name="frontier": "not used"
    try:
        yield
    finally:
        native.missing = missing


def episode(kind: str, side: int = SIDE) -> list[Observation]:
    """What robot 0 observes until the largest map has half of the cells."""
    config = ArenaConfig(height=side, width=side)
    env = ExplorationEnv(
        config, arenas=KINDS[kind](config), terminate_at_coverage=EXPLORED, max_steps=10_000
    )
    steps = play(GoalUtility(config.sight), env, env.max_steps, until_done=True)
    return [robot_observation(now, 0, 0) for now in steps]


def policies(side: int) -> dict[str, Callable[[Observation], int]]:
    """What can decide on board, for robot 0 of four."""
    config = ArenaConfig(height=side, width=side)
    with tempfile.TemporaryDirectory() as folder:
        path = export_npz(untrained(), Path(folder) / "policy.npz")
        actor = ExportedPolicy(path, 0, sample=False)
    return {"goal actor": actor, **{name: make(0, config, 0) for name, make in PLANNERS.items()}}


def measure(kind: str, side: int = SIDE, repeats: int = 20) -> dict[str, dict[str, float]]:
    """Median milliseconds of a decision by policy, with the kernels and with numpy alone."""
    seen = episode(kind, side)
    results: dict[str, dict[str, float]] = {}
    for backend in ("kernels", "numpy alone"):
        with numpy_alone() if backend == "numpy alone" else _as_it_is():
            for name, decide in policies(side).items():
                for before in seen[-20:]:  # a memory of the last steps
                    decide(before)
                last = seen[-1]
                seconds = medians({name: lambda d=decide, last=last: d(last)}, repeats)
                results.setdefault(name, {})[backend] = 1000 * seconds[name]
    return results


@contextmanager
def _as_it_is() -> Iterator[None]:
    yield


def main() -> None:
    torch.set_num_threads(1)
    for kind in KINDS:
        print(f"{kind} of {SIDE} x {SIDE} cells, milliseconds of a decision of one robot of four")
        print(f"{'':>15}{'kernels':>12}{'numpy alone':>14}")
        for name, row in measure(kind).items():
            print(f"{name:>15}{row['kernels']:12.3f}{row['numpy alone']:14.2f}")


if __name__ == "__main__":
    main()
