"""Explorers in a simulated office: how long teams take, and how long a decision takes.

python -m benchmarks.explorers   (about 4 minutes on one core)

20 rooms along a corridor, 20 m x 18 m, maps of 5 cm every 2 s (``tests/helpers/slam.py``). Without
coordination robots still merge maps, but ignore who is nearer to a frontier or has chosen it.
"""

from __future__ import annotations

import time

import numpy as np

from marl_explore.robot.explorer import ExplorerCore, ExplorerSettings, Place
from tests.helpers.slam import Rover, Trial, World

ROOMS, SIDE = 10, 16
"""Rooms on each side of the corridor, in two rows, and cells of a quarter of a metre per room."""
COLUMNS = ("explored after s", "driven m", "decision ms", "99 %", "longest")


def office(seed: int = 0) -> str:
    """A floor plan: each room has a door to the corridor or to the room in front of it."""
    chance = np.random.default_rng(seed)
    across, rows = ROOMS // 2, (0, SIDE, 2 * SIDE + 6, 3 * SIDE + 6)
    plan = np.full((4 * SIDE + 7, across * SIDE + 1), "#")
    for top in rows:
        for room in range(across):
            left = room * SIDE
            plan[top + 1 : top + SIDE, left + 1 : left + SIDE] = "."
            door = left + chance.integers(2, SIDE - 6)
            plan[top + SIDE if top <= SIDE else top, door : door + 4] = "."
            if chance.random() < 0.3 and room + 1 < across:
                door = top + chance.integers(2, SIDE - 6)
                plan[door : door + 4, left + SIDE] = "."
    middle = 2 * SIDE
    plan[middle + 1 : middle + 6, 1:-1] = "."
    for number in range(4):
        plan[middle + 3, 3 + 3 * number] = str(number + 1)
    return "\n".join("".join(row) for row in plan)


def measure(robots: int, coordinated: bool, seed: int = 0, plan: str | None = None) -> list[float]:
    """The numbers of a row."""
    settings = ExplorerSettings(return_to_start=False)
    if not coordinated:
        settings = ExplorerSettings(return_to_start=False, territory=0.0)
    world = World(plan or office(seed))
    names = [f"robot_{number + 1}" for number in range(robots)]
    cores = {
        name: Timed(settings, name, {mate: Place(0.0, 0.0) for mate in names if mate != name})
        for name in names
    }
    rovers = {name: Rover(world, world.starts[name[-1]]) for name in names}
    trial = Trial(world, cores, rovers, maps_every=2.0)
    trial.until(lambda: all(trial.state(name) in ("complete", "stuck") for name in names), 2000)
    took = 1000 * np.array([took for core in cores.values() for took in core.took])
    driven = sum(rover.driven for rover in rovers.values())
    explored = trial.now - settings.settle
    return [explored, driven, took.mean(), np.quantile(took, 0.99), took.max()]


class Timed(ExplorerCore):
    """An explorer that notes how long it decides (seconds)."""

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self.took: list[float] = []

    def advance(self, now: float):
        began = time.perf_counter()
        output = super().advance(now)
        self.took.append(time.perf_counter() - began)
        return output


def main() -> None:
    print("".join(f"{column:>18}" for column in ("robots", *COLUMNS)))
    for robots, coordinated in ((1, True), (2, False), (2, True), (4, False), (4, True)):
        rows = [measure(robots, coordinated, seed) for seed in range(3)]
        numbers = [*np.mean([row[:3] for row in rows], 0), *np.max([row[3:] for row in rows], 0)]
        name = f"{robots}{'' if coordinated else ', alone'}"
        print(f"{name:>18}" + "".join(f"{number:>18.4g}" for number in numbers), flush=True)


if __name__ == "__main__":
    main()
