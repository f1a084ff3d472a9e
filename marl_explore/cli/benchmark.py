"""Run a benchmark on maps of the field; check or repeat the results that someone sends.

marl-explore benchmark run dungeons-4 best nearest-timer mypackage.agents:Explorer --maps FOLDER

marl-explore benchmark run maps-4-lidar hungarian --maps "floors?free=254-255" --cell-size 0.25

marl-explore benchmark check results.json

marl-explore benchmark rerun results.json --maps FOLDER

A benchmark fixes the maps, the robots, their world and the steps. Every policy is one cell; an
interrupted benchmark resumes where it stopped. docs/benchmark.md has the rules and the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from marl_explore.cli.common import parse_action, warn_of_losses
from marl_explore.config.checks import require_threads

if TYPE_CHECKING:
    from marl_explore.evaluation.benchmark import Prepared
    from marl_explore.evaluation.leaderboard import Cell
    from marl_explore.evaluation.leaderboard.cells import Result

CHECK_ARENAS, CHECK_STEPS = 2, 40
"""Played to test that a policy of another package is decentralised."""


@dataclass(frozen=True)
class Run:
    """Options of ``marl-explore benchmark run``."""

    benchmark: Annotated[str, tyro.conf.Positional]
    """dungeons-4, dungeons-4-lidar, dungeons-4-lidar-lossy, dungeons-2 or dungeons-8; maps-4,
    maps-4-lidar, maps-4-lidar-lossy, maps-2 or maps-8 on whatever maps you have."""
    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Planners, run folders, policy files, bundled policies, package.module:attribute;
    NAME=POLICY,POLICY,... makes one row from several training seeds; bound is a lower bound on the
    steps of any team; default: all planners and bound."""
    maps: str = ""
    """Folder of the set, or a clone that has it; for maps-...: a file or folder, with options such
    as "floors?free=195-255"."""
    out: Path = Path("benchmark")
    """The results are written to a folder in it that is named after the benchmark."""
    cell_size: float | None = None
    """For maps-...: side of a cell (metres); default: 0.5. Ranges are the same number of cells."""
    num_maps: int | None = None
    """The first maps only, to try something: such results of a known set are not complete."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_threads(self.threads)
        _require_maps(self.maps)

    def run(self) -> None:
        """Measure what is missing; write tables and the results file."""
        import torch

        from marl_explore.evaluation import benchmark, leaderboard
        from marl_explore.planners import PLANNERS
        from marl_explore.utils import records

        torch.set_num_threads(self.threads)
        record = records.provenance() | {"settings": asdict(self) | {"out": str(self.out)}}
        chosen = benchmark.find_benchmark(self.benchmark)
        prepared = chosen.prepare(self.maps, self.cell_size, self.num_maps)
        if chosen.map_set is None:
            warn_of_losses(self.maps, prepared.suite.config.cell_size)
        folder = _folder(self.out / chosen.name)
        entries = leaderboard.parse_entries(self.policies or (*PLANNERS, leaderboard.BOUND))
        policies = [policy for entry in entries for policy in entry.policies]
        measured, checked = _measure(policies, prepared, folder)
        rows = {entry.name: [measured[policy] for policy in entry.policies] for entry in entries}
        boards = [leaderboard.rank(rows)]
        leaderboard.write_tables(folder, boards, record, benchmark.COLUMNS, benchmark.MEANINGS)
        played = {e.name: rows[e.name] for e in entries if leaderboard.BOUND not in e.policies}
        content = benchmark.make_results(prepared, played, checked, record)
        benchmark.write_results(folder / "results.json", content)
        print((folder / "table.txt").read_text(), end="")
        hours = sum(result["run"]["seconds"] for result in measured.values()) / 3600
        print(f"{hours:.2f} hours of computing")
        for name in ("results.json", "table.md", "table.csv", "table.json"):
            print(folder / name)


@dataclass(frozen=True)
class Check:
    """Options of ``marl-explore benchmark check``."""

    results: Annotated[Path, tyro.conf.Positional]
    """A results.json."""

    def run(self) -> None:
        """Say that the file is whole and keeps to the protocol, or what is wrong with it."""
        from marl_explore.evaluation.benchmark import read_results

        content = read_results(self.results)
        print(
            f"{self.results}: {content['benchmark']} on {len(content['maps'])} maps, "
            f"{', '.join(content['entries'])}: whole, and to the protocol"
        )


@dataclass(frozen=True)
class Rerun:
    """Options of ``marl-explore benchmark rerun``."""

    results: Annotated[Path, tyro.conf.Positional]
    """A results.json."""
    maps: str = ""
    """As for ``run``."""
    only: tuple[str, ...] = ()
    """Policies to repeat; default: all but those of other packages, whose code is only run if they
    are named."""
    out: Path = Path("rerun")
    """Where the cells are kept, so that an interrupted rerun resumes."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_threads(self.threads)
        _require_maps(self.maps)

    def run(self) -> None:
        """Measure the policies once more, and say whether the numbers are the same.

        Raises:
            ValueError: when they are not.
        """
        import torch

        from marl_explore.evaluation import benchmark

        torch.set_num_threads(self.threads)
        content = benchmark.read_results(self.results)
        chosen = benchmark.find_benchmark(content["benchmark"])
        cell_size = content["settings"]["arena"]["cell_size"] if chosen.map_set is None else None
        prepared = chosen.prepare(self.maps, cell_size)
        benchmark.require_same_maps(prepared, content)
        entries = self._chosen(content)
        policies = [theirs["policy"] for theirs in entries]
        measured, _ = _measure(policies, prepared, _folder(self.out / chosen.name))
        found = list(benchmark.repeated(entries, measured, prepared))
        for one in found:
            print(one)
        others = [one.policy for one in found if one.differences]
        if others:
            raise ValueError(f"other numbers than in {self.results}: {', '.join(others)}")

    def _chosen(self, content: dict[str, Any]) -> list[dict[str, Any]]:
        """The policies of the file that are to be repeated."""
        from marl_explore.evaluation.registry import is_outside

        every = [theirs for policies in content["entries"].values() for theirs in policies]
        known = [theirs["policy"] for theirs in every]
        if strange := [name for name in self.only if name not in known]:
            raise ValueError(f"only={strange[0]!r} is not allowed: the file has {known}")
        if self.only:
            return [theirs for theirs in every if theirs["policy"] in self.only]
        outside = [name for name in known if is_outside(name)]
        if outside:
            print(f"not run, as it is code of others: {', '.join(outside)} (name them with --only)")
        return [theirs for theirs in every if theirs["policy"] not in outside]


Action = Run | Check | Rerun


def parse(words: Sequence[str], prog: str = "marl-explore benchmark") -> Action:
    """Parse a command line."""
    return parse_action({"run": Run, "check": Check, "rerun": Rerun}, words, prog, __doc__)


def run(arguments: Action) -> None:
    """Do what was asked for."""
    arguments.run()


def _require_maps(maps: str) -> None:
    if not maps:
        raise ValueError("maps='' is not allowed: name the folder of the maps, --maps FOLDER")


def _folder(path: Path) -> Path:
    """A new folder, or one that has cells."""
    from marl_explore.utils import records

    return path if (path / "cells").is_dir() else records.new_folder(path)


def _measure(
    policies: Sequence[str], prepared: Prepared, folder: Path
) -> tuple[dict[str, Result], list[str]]:
    """Results by policy, and the policies that were tested to be decentralised."""
    from marl_explore.evaluation import leaderboard
    from marl_explore.evaluation.benchmark import SEED
    from marl_explore.evaluation.knowledge import require_decentralised
    from marl_explore.evaluation.registry import find_policy, is_outside

    suite = prepared.suite
    number = suite.num_arenas or 1
    checked = []
    for name in filter(is_outside, policies):
        if not getattr(find_policy(name, suite.config), "reference", False):
            few = min(CHECK_ARENAS, number)
            require_decentralised(name, suite.config, few, CHECK_STEPS, arenas=suite.arenas)
            checked.append(name)
    cells: dict[str, Cell] = {
        name: leaderboard.Cell(name, suite, number, suite.steps, SEED) for name in policies
    }
    results = leaderboard.make_cells(folder / "cells", cells.values())
    return {name: results[cell] for name, cell in cells.items()}, checked
