"""Peak memory that an environment adds to the process, for large batches and large arenas.

python -m benchmarks.memory
"""

from __future__ import annotations

import resource
import subprocess
import sys

CASES = {
    "4096 arenas x 4 robots x 12 x 12": (4096, 4, 12),
    "64 arenas x 8 robots x 128 x 128": (64, 8, 128),
    "1 arena x 100 robots x 200 x 200": (1, 100, 200),
}


def peak_megabytes() -> float:
    """Peak resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(num_envs: int, robots: int, side: int, steps: int = 10) -> float:
    """Megabytes added by making an environment and taking some steps."""
    from marl_explore import ArenaConfig, make_env

    make_env(num_envs=1).rollout(1)  # what the libraries take is not the environment's
    before = peak_megabytes()
    config = ArenaConfig(height=side, width=side, num_agents=robots)
    env = make_env(config, num_envs, max_steps=5)
    td = env.reset()
    for _ in range(steps):
        _, td = env.step_and_maybe_reset(env.rand_action(td))
    return peak_megabytes() - before


def main() -> None:
    for name, case in CASES.items():
        code = f"from benchmarks.memory import measure; print(measure{case})"
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True
        )
        print(f"{name}: {float(done.stdout):.0f} MB")


if __name__ == "__main__":
    main()
