"""The fault campaign: teams of robots explore while messages, clocks and robots fail.

python -m benchmarks.robot_faults [runs per mix]

Every mix of faults (``tests/helpers/faulty_world.py``) in several random arenas: how many teams
finished, wrong cells in the maps of living robots, and the smallest gaps between bodies.
"""

from __future__ import annotations

import statistics
import sys

from tests.helpers.faulty_world import MIXES, explore


def main(runs: int = 10) -> None:
    print(f"{'':>30} finished  seconds  wrong cells  robots apart (m)  boxes apart (m)")
    for name, faults in MIXES.items():
        found = [explore(faults, seed) for seed in range(runs)]
        print(
            f"{name:>30} {sum(run.finished for run in found):>5}/{runs:<2}"
            f"{statistics.median(run.seconds for run in found):>9.0f}"
            f"{sum(run.wrong_cells for run in found):>13}"
            f"{min(run.closest for run in found):>18.3f}"
            f"{min(run.gap for run in found):>17.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
