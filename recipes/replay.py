"""Write one HTML file in which policies explore the same test arena, to play in any browser.

python recipes/replay.py runs/my-run nearest-timer --arena-index 3

Episodes end when one robot's map is complete. The arena's size and robots are those the first
trained policy was trained for, changed by the flags.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore import cli
from marl_explore.config import ArenaConfig, require_integer


@dataclass(frozen=True)
class Arguments:
    """Which policies, on which arena."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run folders, policy files, bundled policies or planners."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    arenas: str = "uniform"
    """A suite, whose size and density then are the arena's, or uniform."""
    arena_index: int = 0
    """Test arena; those of evaluate.py are 0, 1, 2, ..."""
    seed: int = 0
    """Seed of the arena and of sampled actions."""
    steps: int | None = None
    """Most steps of an episode; default: the suite's, 300 for uniform arenas."""
    out: Path = Path("replay.html")
    """File to write; an earlier one is replaced."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("arena_index", self.arena_index, 0)
        require_integer("seed", self.seed, 0)
        if self.steps is not None:
            require_integer("steps", self.steps, 1)


def parse() -> Arguments:
    """Read the command line; a trained policy's arena is the default of the arena's flags."""
    return tyro.cli(
        Arguments,
        prog="replay.py",
        description=__doc__,
        default=Arguments((), *cli.default_task(sys.argv[1:])),
        config=cli.OPTIONS,
    )


def run(arguments: Arguments) -> None:
    """Let every policy explore the arena, and write the page."""
    from marl_explore import runs
    from marl_explore.evaluation import find_policy, watch
    from marl_explore.replay import write_replay

    if not arguments.policies:
        raise ValueError("name at least one policy, such as random or a run folder")
    record = runs.provenance()
    policies = {name: find_policy(name, arguments.arena) for name in arguments.policies}
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
