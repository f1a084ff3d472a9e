"""Measured again: whether the numbers of a results file are those that its policies have here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from marl_explore.evaluation.benchmark.protocol import Prepared
from marl_explore.evaluation.leaderboard.cells import Result


class Repeated(NamedTuple):
    """A policy of a results file, measured once more."""

    policy: str
    differences: tuple[str, ...]
    """Measures that have other numbers, each with one map on which they differ."""
    notes: tuple[str, ...]
    """What is not as it was: the weights of the policy, the code."""

    def __str__(self) -> str:
        """What was found, in words."""
        found = "; ".join(self.differences) if self.differences else "the same numbers"
        notes = f" ({', '.join(self.notes)})" if self.notes else ""
        return f"{self.policy}: {found}{notes}"


def require_same_maps(prepared: Prepared, content: Mapping[str, Any]) -> None:
    """Raise an error unless a user's maps are those of a results file.

    Raises:
        ValueError: naming the first map that is another one, or when they are read otherwise.
    """
    theirs = {entry["name"]: entry["sha256"] for entry in content["maps"]}
    if [*theirs] != [*prepared.maps]:
        raise ValueError(
            f"the maps are not those of the file: it has {len(theirs)}, and these are "
            f"{len(prepared.maps)}"
        )
    for name, sha in prepared.maps.items():
        if theirs[name] != sha:
            raise ValueError(f"the map {name} is not that of the file: its SHA-256 is {sha}")
    if prepared.suite.digest != content["fingerprint"]:
        raise ValueError("the maps are read otherwise than for the file, which gives other arenas")


def repeated(
    policies: Sequence[Mapping[str, Any]], results: Mapping[str, Result], prepared: Prepared
) -> Iterator[Repeated]:
    """Compare the policies of a results file with new results of them.

    Args:
        policies: of the file.
        results: by policy.
        prepared: the maps on which both were measured.
    """
    for theirs in policies:
        ours = results[theirs["policy"]]
        parts = ("weights", "code")
        notes = [f"other {part}" for part in parts if ours["settings"][part] != theirs[part]]
        differences = _differences(theirs["scores"], ours["scores"], [*prepared.maps])
        yield Repeated(theirs["policy"], tuple(differences), tuple(notes))


def _differences(
    theirs: Mapping[str, Sequence[float]],
    ours: Mapping[str, Sequence[float]],
    maps: Sequence[str],
) -> Iterator[str]:
    for name, before in theirs.items():
        now = ours.get(name)
        if now is None:
            yield f"{name} is not measured any more"
            continue
        other = [i for i, (one, two) in enumerate(zip(before, now, strict=True)) if one != two]
        if other:
            first = other[0]
            yield (
                f"{name} differs on {len(other)} of {len(maps)} maps (on {maps[first]} it was "
                f"{before[first]:g} and is {now[first]:g})"
            )
