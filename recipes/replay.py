"""Write one HTML file in which policies explore the same test arena, to play in any browser.

python recipes/replay.py runs/my-run nearest-timer --arena-index 3

Episodes end when one robot's map is complete. The arena's size and robots are those the first
trained policy was trained for, changed by the flags.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from marl_explore import cli
from marl_explore.config import require_integer


@dataclass(frozen=True)
class Arguments(cli.Task):
    """Which policies, on which arena."""

    arena_index: int = 0
    """Test arena; those of evaluate.py are 0, 1, 2, ..."""
    out: Path = Path("replay.html")
    """File to write; an earlier one is replaced."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        require_integer("arena_index", self.arena_index, 0)


def parse() -> Arguments:
    """Read the command line."""
    return cli.parse_task(Arguments, "replay.py", __doc__)


def run(arguments: Arguments) -> None:
    """Let every policy explore the arena, and write the page."""
    from marl_explore import runs
    from marl_explore.evaluation import watch
    from marl_explore.replay import write_replay

    record = runs.provenance()
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


if __name__ == "__main__":
    cli.main(parse, run)
