"""What a leaderboard compares: names, and the policies behind each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Entry(NamedTuple):
    """A row of the leaderboard."""

    name: str
    """How the row is called."""
    policies: tuple[str, ...]
    """Planner, or policies as ``load_policy`` takes them, one per training seed."""


def parse_entries(words: Sequence[str]) -> list[Entry]:
    """Entries from words: "POLICY", or "NAME=POLICY,POLICY,..." for the seeds of one training.

    Raises:
        ValueError: for a name that comes twice or names nothing.
    """
    entries: list[Entry] = []
    for word in words:
        name, _, policies = word.partition("=")
        entry = Entry(name, tuple(policies.split(","))) if "=" in word else Entry(word, (word,))
        if not name or not all(entry.policies):
            raise ValueError(f"policies={word!r} is not allowed: use NAME=POLICY,POLICY,...")
        if name in [other.name for other in entries]:
            raise ValueError(f"policies={name!r} comes twice: give each its own name, NAME=POLICY")
        entries.append(entry)
    return entries
