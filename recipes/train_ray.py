"""Train a team with workers on a Ray cluster; docs/scaling.md says how to start one.

python recipes/train_ray.py fast --workers 2

python recipes/train_ray.py fast --workers 32 --ray-address auto

python recipes/train_ray.py resume runs/my-run
"""

import sys

from marl_explore import run_command


def words(given: list[str]) -> list[str]:
    """Arguments of ``marl-explore train`` with Ray, and two workers if no number is given."""
    if given[:1] in ([], ["resume"], ["--help"], ["-h"]):
        return given
    return [given[0], "--collector", "ray", "--workers", "2", *given[1:]]


if __name__ == "__main__":
    run_command("train", words(sys.argv[1:]))
