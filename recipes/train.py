"""Train a team with HAPPO.

python recipes/train.py fast

python recipes/train.py paper-cnn-case2 --seed 1 --out runs/cnn-case2-seed1

python recipes/train.py fast --arenas rooms-32
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from marl_explore import cli
from marl_explore.config import PRESETS, TrainConfig, require_integer


@dataclass(frozen=True)
class Arguments:
    """Everything a training run can be told."""

    train: TrainConfig = field(default_factory=TrainConfig)
    out: Path | None = None
    """New run folder; default: runs/ and the time."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("threads", self.threads, 1)


def parse() -> Arguments:
    """Read the command line: a preset, and what to change in it.

    A suite that it names brings its size and density, which other flags then cannot change.
    """
    arenas = cli.named_arenas(sys.argv[1:]) or "uniform"
    presets = {
        name: (
            f"{c.architecture}, reward {c.reward}, {c.episodes} episodes",
            Arguments(train=replace(c, arena=cli.fitted(c.arena, arenas))),
        )
        for name, c in PRESETS.items()
    }
    return tyro.extras.overridable_config_cli(
        presets, prog="train.py", description=__doc__, config=cli.OPTIONS
    )


def run(arguments: Arguments) -> None:
    """Train, and say where the results are."""
    import torch

    from marl_explore import runs

    torch.set_num_threads(arguments.threads)
    folder = arguments.out or Path("runs") / time.strftime("%Y%m%d-%H%M%S")
    runs.train(arguments.train, folder)
    print(f"policy and training curves: {folder}")
    print(f"evaluate it: python recipes/evaluate.py {folder} random nearest nearest-timer")


if __name__ == "__main__":
    cli.main(parse, run)
