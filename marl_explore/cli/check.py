"""Test whether the robots of a policy act only on what they can know.

marl-explore check mypackage.agents:Explorer

marl-explore check runs/my-run nearest-timer --arenas faulty-32 --steps 100

Some episodes are played. Then, for every robot in turn, all that it cannot know is changed (the
obstacles, the other robots' maps, where robots are that it is not linked to, ...), and its actions
have to stay the same. The first that does not is an error that names robot, step and change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from marl_explore.cli.common import Task, parse_task
from marl_explore.config.checks import require_integer


@dataclass(frozen=True)
class Arguments(Task):
    """Options of ``marl-explore check``."""

    num_arenas: int = 4
    """Test arenas that are played."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        super().__post_init__()
        require_integer("num_arenas", self.num_arenas, 1)


def parse(words: Sequence[str], prog: str = "marl-explore check") -> Arguments:
    """Parse a command line."""
    return parse_task(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Test every policy; the first that fails is an error."""
    from marl_explore.evaluation.knowledge import STEPS, require_decentralised

    arguments.find_policies()  # refused before any is tested
    steps = arguments.steps or STEPS
    for name in arguments.policies:
        require_decentralised(
            name,
            arguments.arena,
            arguments.num_arenas,
            steps,
            arguments.seed,
            arguments.arenas,
        )
        print(
            f"{name}: {arguments.arena.num_agents} robots acted on what they know, for {steps} "
            f"steps in {arguments.num_arenas} arenas"
        )
