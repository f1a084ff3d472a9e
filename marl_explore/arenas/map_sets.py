"""Sets of maps that others publish: which files belong to one, and whether a copy is whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from marl_explore.arenas.maps import Reading
from marl_explore.arenas.sources import MapSource
from marl_explore.config.checks import require
from marl_explore.utils.files import file_digest


@dataclass(frozen=True)
class MapSet:
    """A set of maps that does not come with the package, and how its files are read."""

    name: str
    origin: str
    """Where its files come from, and under which license."""
    inside: str
    """The folder of the maps in a clone of that repository."""
    reading: Reading
    starts: str = "clustered"

    @cached_property
    def digests(self) -> Mapping[str, str]:
        """SHA-256 of every file by its name, in the order of names."""
        text = files(__package__).joinpath(f"{self.name}.sha256").read_text(encoding="utf-8")
        return {name: digest for digest, name in map(str.split, text.splitlines())}

    def folder(self, place: str | Path) -> Path:
        """Where the maps lie: in a folder, or further inside a clone of the repository."""
        place, inside = Path(place), Path(place, self.inside)
        return inside if inside.is_dir() else place

    def compare(self, place: str | Path) -> Comparison:
        """Compare the files of a folder, or of a clone, with those of the set."""
        folder = self.folder(place)
        missing = [name for name in self.digests if not (folder / name).is_file()]
        different = [
            name
            for name, digest in self.digests.items()
            if name not in missing and file_digest(folder / name) != digest
        ]
        return Comparison(tuple(missing), tuple(different))

    def require(self, place: str | Path) -> None:
        """Raise an error unless a folder has all files of the set, as they were published.

        Raises:
            ValueError: naming files that are missing, and those that differ.
        """
        found = self.compare(place)
        faults = [
            f"{len(names)} of the {len(self.digests)} maps of {self.name!r} {what}: {_few(names)}"
            for what, names in zip(("are missing", "are different"), found, strict=True)
            if names
        ]
        if faults:
            folder = str(self.folder(place))
            raise ValueError(
                f"maps={folder!r} is not allowed: {'; '.join(faults)}. They come from {self.origin}"
            )

    def source(self, place: str | Path) -> MapSource:
        """The maps of a folder, in the order of their names.

        Raises:
            ValueError: as ``require``.
        """
        self.require(place)
        folder = self.folder(place)
        paths = tuple(folder / name for name in self.digests)
        return MapSource(paths, self.reading, self.starts)


class Comparison(NamedTuple):
    """How a folder differs from a set; further files in it do not matter."""

    missing: tuple[str, ...]
    different: tuple[str, ...]


def _few(names: tuple[str, ...], shown: int = 3) -> str:
    """Some names, and how many more there are."""
    rest = len(names) - shown
    return ", ".join(names[:shown]) + (f" and {rest} more" if rest > 0 else "")


DUNGEONS = MapSet(
    name="dungeons",
    origin=(
        "https://github.com/RobustFieldAutonomyLab/DRL_robot_exploration (DungeonMaps/test; "
        "Robust Field Autonomy Lab, BSD 3-Clause)"
    ),
    inside="DungeonMaps/test",
    # corridors are one coarse cell of 16 pixels wide: cells of 8 pixels let robots pass each other
    reading=Reading(resolution=0.0625, free="195-255", occupied="0-127", start_value=203),
)
"""A hundred dungeons of 30 x 40 coarse cells, images of 640 x 480 pixels."""
MAP_SETS = {DUNGEONS.name: DUNGEONS}


def find_set(name: str) -> MapSet:
    """The set with this name.

    Raises:
        ValueError: listing the known ones.
    """
    require(name in MAP_SETS, "set", name, f"use one of {[*MAP_SETS]}")
    return MAP_SETS[name]
