"""Train a team with workers of a Ray cluster; docs/scaling.md says how to start one.

python recipes/train_ray.py fast --workers 2

python recipes/train_ray.py fast --workers 32 --ray-address auto

python recipes/train_ray.py resume runs/my-run
"""

from __future__ import annotations

from functools import partial

import train

from marl_explore import cli
from marl_explore.execution import RunConfig

parse = partial(train.parse, "train_ray.py", __doc__, RunConfig(collector="ray", workers=2))

if __name__ == "__main__":
    cli.main(parse, train.run)
