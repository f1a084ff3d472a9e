"""Train a team with HAPPO, MAPPO or IPPO, and go on with what was stopped.

python recipes/train.py fast

python recipes/train.py paper-cnn-case2 --seed 1 --out runs/cnn-case2-seed1

python recipes/train.py fast --arenas rooms-32

python recipes/train.py resume runs/cnn-case2-seed1

python recipes/train.py fast --seeds 0-4 --out runs/fast
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from marl_explore import cli
from marl_explore.config import TrainConfig, require_integer
from marl_explore.execution import RunConfig, parse_seeds
from marl_explore.presets import PRESETS


@dataclass(frozen=True)
class Start:
    """Everything a training run can be told."""

    train: TrainConfig = field(default_factory=TrainConfig)
    run: RunConfig = field(default_factory=RunConfig)
    out: Path | None = None
    """New run folder; default: runs/ and the time."""
    seeds: str | None = None
    """A run per seed, in folders of their own: 0-4 or 0,2,7; it replaces seed."""
    jobs: int | None = None
    """Runs side by side, with seeds; default: as many as there are cores for."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if self.seeds is not None:
            parse_seeds(self.seeds)
        if self.jobs is not None:
            require_integer("jobs", self.jobs, 1)


@dataclass(frozen=True)
class Resume:
    """Go on with a run from its last checkpoint, or with all runs of a sweep over seeds."""

    folder: tyro.conf.Positional[Path]
    """Folder of the run or the sweep."""
    from_previous: bool = False
    """Whether to go on from the checkpoint before the last one."""


Arguments = Start | Resume


def parse(
    prog: str = "train.py", about: str | None = __doc__, run: RunConfig | None = None
) -> Arguments:
    """Read the command line: a preset and what to change in it, or a run to go on with.

    A suite that it names brings its size and density, which other flags then cannot change.
    """
    run = run or RunConfig()
    arenas = cli.named_arenas(sys.argv[1:]) or "uniform"
    choices: list[Any] = [
        Annotated[
            Start,
            tyro.conf.subcommand(
                name,
                default=Start(train=replace(c, arena=cli.fitted(c.arena, arenas)), run=run),
                description=f"{c.architecture}, reward {c.reward}, {c.episodes} episodes",
            ),
        ]
        for name, c in PRESETS.items()
    ]
    choices.append(Annotated[Resume, tyro.conf.subcommand("resume")])
    kinds: Any = Union[tuple(choices)]  # noqa: UP007 - made at run time
    return tyro.cli(kinds, prog=prog, description=about, config=cli.OPTIONS)


def run(arguments: Arguments) -> None:
    """Train, and say where the results are."""
    from marl_explore import runs, sweeps

    summary = None
    if isinstance(arguments, Resume):
        folder = arguments.folder
        if sweeps.is_sweep(folder):
            if arguments.from_previous:
                raise ValueError(
                    f"from_previous=True is not allowed for the sweep {folder}: resume one of its "
                    "runs with it, such as seed-0"
                )
            summary = sweeps.resume_sweep(folder)
        else:
            runs.resume(folder, from_previous=arguments.from_previous)
    else:
        folder = arguments.out or Path("runs") / time.strftime("%Y%m%d-%H%M%S")
        if arguments.seeds is not None:
            seeds = parse_seeds(arguments.seeds)
            summary = sweeps.sweep(arguments.train, folder, seeds, arguments.run, arguments.jobs)
        else:
            runs.train(arguments.train, folder, arguments.run)
    if summary is None:
        print(f"policy and training curves: {folder}")
        print(f"evaluate it: python recipes/evaluate.py {folder} random nearest nearest-timer")
    else:
        print(sweeps.format_summary(summary))
        print(f"runs and every metric over seeds: {folder}")


if __name__ == "__main__":
    cli.main(parse, run)
