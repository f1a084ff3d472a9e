"""Entries of a leaderboard: names, and the policies behind each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from marl_explore.planners import PLANNERS

BOUND = "bound"
"""In place of a policy: ``planners.counting_bound``."""


class Entry(NamedTuple):
    """A row of the leaderboard."""

    name: str
    """Name of the row."""
    policies: tuple[str, ...]
    """Planner, or policies as ``load_policy`` takes them, one per training seed."""


def parse_entries(words: Sequence[str]) -> list[Entry]:
    """Entries from words: "POLICY", or "NAME=POLICY,POLICY,..." for several training seeds.

    Raises:
        ValueError: for a name that appears twice or has no policy.
    """
    entries: list[Entry] = []
    for word in words:
        name, _, policies = word.partition("=")
        entry = Entry(name, tuple(policies.split(","))) if "=" in word else Entry(word, (word,))
        if not name or not all(entry.policies):
            raise ValueError(f"policies={word!r} is not allowed: use NAME=POLICY,POLICY,...")
        if len(set(entry.policies)) < len(entry.policies):
            raise ValueError(f"policies={word!r} is not allowed: each may appear only once")
        untrained = [policy for policy in entry.policies if policy in (*PLANNERS, BOUND)]
        if untrained and len(entry.policies) > 1:
            raise ValueError(
                f"policies={word!r} is not allowed: {untrained[0]!r} is not trained, so it cannot "
                "be one of several training seeds"
            )
        if name in [other.name for other in entries]:
            raise ValueError(f"policies={name!r} is given twice: use a name for each, NAME=POLICY")
        entries.append(entry)
    return entries
