"""Maps of the field: check a copy of a set, or draw maps like its maps.

marl-explore maps check DRL_robot_exploration

marl-explore maps draw drawn --number 5

The package has the names of the files of a set and their SHA-256, and no maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore.cli.common import parse_action


@dataclass(frozen=True)
class Check:
    """Options of ``marl-explore maps check``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the maps, or a clone of the repository that they come from."""
    set: str = "dungeons"
    """Name of the set."""

    def run(self) -> None:
        """Say that the set is whole, or what is missing or different."""
        from marl_explore.arenas.map_sets import find_set

        found = find_set(self.set)
        found.require(self.folder)
        print(f"{found.folder(self.folder)} has all {len(found.digests)} maps of {found.name!r}")


@dataclass(frozen=True)
class Draw:
    """Options of ``marl-explore maps draw``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Where to write dungeon_SEED.png, ...; created if it does not exist."""
    number: int = 5
    """How many dungeons."""
    seed: int = 0
    """Of the first dungeon; the next ones have the next seeds."""
    rows: int = 30
    """Coarse cells from north to south."""
    columns: int = 40
    """Coarse cells from west to east."""
    pixels: int = 16
    """Pixels of a coarse cell a side."""

    def run(self) -> None:
        """Draw the dungeons, and say how they are read."""
        from marl_explore.arenas.dungeons import write_dungeons

        paths = write_dungeons(
            self.folder, self.number, self.seed, self.rows, self.columns, self.pixels
        )
        resolution = 1 / self.pixels  # two cells of 0.5 m for a coarse one
        reading = f"resolution={resolution:g}&free=195-255&start_value=203"
        print(f'{len(paths)} maps; as arenas: "{self.folder}?{reading}"')


Action = Check | Draw


def parse(words: Sequence[str], prog: str = "marl-explore maps") -> Action:
    """Parse a command line."""
    return parse_action({"check": Check, "draw": Draw}, words, prog, __doc__)


def run(arguments: Action) -> None:
    """Do what was asked for."""
    arguments.run()
