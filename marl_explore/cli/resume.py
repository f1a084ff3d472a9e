"""Resume a training run, or a sweep over seeds, from its last checkpoints, or make it longer.

marl-explore resume runs/cnn-case2-seed1

marl-explore resume runs/cnn-case2-seed1 --episodes 10000
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer

if TYPE_CHECKING:
    from marl_explore.training.seeds import Summary


@dataclass(frozen=True)
class Resume:
    """Resume a run from its last checkpoint, or all runs of a sweep over seeds."""

    folder: tyro.conf.Positional[Path]
    """Folder of the run or the sweep."""
    from_previous: bool = False
    """Whether to resume from the checkpoint before the last one."""
    episodes: int | None = None
    """New length of the run, or of every run of the sweep, to make it longer (episodes)."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        if self.episodes is not None:
            require_integer("episodes", self.episodes, 1)


def parse(words: Sequence[str], prog: str = "marl-explore resume") -> Resume:
    """Parse a command line."""
    return parse_options(Resume, words, prog, __doc__)


def run(arguments: Resume) -> None:
    """Finish the run, and print where the results are."""
    from marl_explore.training import runs, seeds

    folder, summary = arguments.folder, None
    if not seeds.is_sweep(folder):
        runs.resume(folder, arguments.from_previous, episodes=arguments.episodes)
    elif arguments.from_previous:
        raise ValueError(
            f"from_previous=True is not allowed for the sweep {folder}: resume one of its runs "
            "with it, such as seed-0"
        )
    else:
        summary = seeds.resume_sweep(folder, arguments.episodes)
    report(folder, summary)


def report(folder: Path, summary: Summary | None) -> None:
    """Print where the results of a run, or of a sweep with this summary, are."""
    from marl_explore.training import seeds

    if summary is None:
        print(f"policy and training curves: {folder}")
        print(f"evaluate it: marl-explore evaluate {folder} random nearest nearest-timer")
    else:
        print(seeds.format_summary(summary))
        print(f"runs and every metric over seeds: {folder}")
