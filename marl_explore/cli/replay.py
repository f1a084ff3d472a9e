"""Write an HTML file that replays policies in the same test arena, for any browser.

marl-explore replay runs/my-run nearest-timer --arena-index 3

Episodes end when one robot's map is complete. The arena's size and robots are those that the first
trained policy was trained for, unless flags change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from marl_explore.cli.common import Task, parse_task
from marl_explore.config.checks import require_integer


@dataclass(frozen=True)
class Arguments(Task):
    """Options of ``marl-explore replay``."""

    arena_index: int = 0
    """Index of the test arena; marl-explore evaluate uses 0, 1, 2, ..."""
    out: Path = Path("replay.html")
    """File to write; an earlier one is replaced."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        super().__post_init__()
        require_integer("arena_index", self.arena_index, 0)


def parse(words: Sequence[str], prog: str = "marl-explore replay") -> Arguments:
    """Parse a command line."""
    return parse_task(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Run every policy in the arena, and write the page."""
    from marl_explore.evaluation.episodes import watch
    from marl_explore.evaluation.replay import write_replay
    from marl_explore.utils import records

    record = records.provenance()
    policies = arguments.find_policies()
    episodes = {
        name: watch(
            policy,
            arguments.arena,
            arguments.arena_index,
            arguments.steps,
            arguments.seed,
            arenas=arguments.arenas,
        )
        for name, policy in policies.items()
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    about = f"{record['command']} ({versions})"
    write_replay(episodes, arguments.out, config=arguments.arena, about=about)
    print(arguments.out)
