"""Compare policies on suites of test arenas: one table, and one HTML report with figures.

marl-explore leaderboard nearest-timer random --suites paper-12 rooms-32

marl-explore leaderboard learned=runs/seed-0,runs/seed-1 nearest-timer --out boards/mine

Every policy on every suite is one file in OUT/cells. An interrupted leaderboard resumes where it
stopped, and a later one measures only what is new or was measured by other code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer, require_threads

if TYPE_CHECKING:
    from marl_explore.arenas import Suite
    from marl_explore.evaluation.leaderboard import Cell


ARENAS = ((12, 200), (24, 50))
"""Test arenas up to a size of side x side cells; 20 above that, where planning is slow."""


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore leaderboard``."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Planners, run folders, policy files, bundled policies or package.module:attribute;
    NAME=POLICY,POLICY,... makes one row from several training seeds; bound is a lower bound on the
    steps of any team; default: all planners and bound."""
    suites: tuple[str, ...] = ()
    """Suites of arenas, or files and folders of maps; default: all suites that do not bring robots
    of their own."""
    num_arenas: int | None = None
    """Test arenas per suite; default: the suite's, or 200, 50 above 12 x 12 cells, 20 above 24 x 24
    cells."""
    steps: int | None = None
    """Length of every episode in steps; default: the suite's."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path = Path("leaderboard")
    """Folder of the results."""
    threads: int = 1
    """CPU threads of torch."""
    device: str = "cpu"
    """Where to compute: cpu, cuda, cuda:1, ... (CUDA is not tested)."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        for name in ("num_arenas", "steps"):
            if getattr(self, name) is not None:
                require_integer(name, getattr(self, name), 1)
        require_integer("seed", self.seed, 0)
        require_threads(self.threads)


def parse(words: Sequence[str], prog: str = "marl-explore leaderboard") -> Arguments:
    """Parse a command line."""
    arguments = parse_options(Arguments, words, prog, __doc__)
    if "--suites" in words and not arguments.suites:
        raise ValueError("suites=() is not allowed: name at least one suite, or leave it out")
    return arguments


def run(arguments: Arguments) -> None:
    """Measure what is missing, rank, and write tables and report."""
    import torch

    from marl_explore.arenas import is_source, map_suite, suite
    from marl_explore.arenas.suites import SUITES
    from marl_explore.evaluation import leaderboard
    from marl_explore.planners import PLANNERS
    from marl_explore.utils import records

    torch.set_num_threads(arguments.threads)
    record = records.provenance() | {"settings": asdict(arguments)}
    if not (arguments.out / "cells").is_dir():
        records.require_new(arguments.out)
    entries = leaderboard.parse_entries(arguments.policies or (*PLANNERS, leaderboard.BOUND))
    suites = [map_suite(name) if is_source(name) else suite(name) for name in arguments.suites] or [
        entry for entry in SUITES if not entry.brings_robots
    ]

    def cell(policy: str, place: Suite) -> Cell:
        by_size = next((n for side, n in ARENAS if place.config.num_cells <= side**2), 20)
        return leaderboard.Cell(
            policy,
            place,
            num_arenas=arguments.num_arenas or place.num_arenas or by_size,
            steps=arguments.steps or place.steps,
            seed=arguments.seed,
            device=arguments.device,
        )

    def cells(place: Suite) -> dict[str, list[Cell]]:
        return {e.name: [cell(policy, place) for policy in e.policies] for e in entries}

    wanted = {place.id: cells(place) for place in suites}
    all_cells = [c for rows in wanted.values() for row in rows.values() for c in row]
    results = leaderboard.make_cells(arguments.out / "cells", all_cells)
    boards = [
        leaderboard.rank({name: [results[c] for c in row] for name, row in rows.items()})
        for rows in wanted.values()
    ]
    leaderboard.write_tables(arguments.out, boards, record)
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    about = f"{record['command']} ({versions})"
    leaderboard.write_report(arguments.out / "report.html", boards, about)
    print((arguments.out / "table.txt").read_text(), end="")
    for name in ("table.md", "table.csv", "table.json", "report.html"):
        print(arguments.out / name)
