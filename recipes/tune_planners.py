"""Compare settings of the planners on validation arenas; the best ones are those of PLANNERS.

python recipes/tune_planners.py utility-cost

Copy this file and change the settings: nothing here touches the test arenas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from marl_explore import cli
from marl_explore.config import ArenaConfig, require_integer

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

MEASURES = (
    "steps_to_95",
    "steps_to_100",
    "complete",
    "communication_share_before_completion",
    "useful_share_before_completion",
)


@dataclass(frozen=True)
class Arguments:
    """Which planner, on how many arenas."""

    planner: Annotated[str, tyro.conf.Positional]
    """nearest-timer, utility-cost, hedac or rendezvous."""
    num_arenas: int = 100
    """Validation arenas of the paper's size."""
    steps: int = 120
    """Steps of every episode."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("steps", self.steps, 1)


def candidates(planner: str, config: ArenaConfig) -> dict[str, TensorDictModuleBase]:
    """The settings of a planner that are compared, by a name for each."""
    from marl_explore import planners as p

    reach = config.communication_cells
    families: dict[str, Callable[[], dict[str, TensorDictModuleBase]]] = {
        "nearest-timer": lambda: {
            f"timer {k}": p.NearestFrontier(p.PairTimer(k, reach)) for k in (4, 5, 6, 8)
        },
        "utility-cost": lambda: {
            f"timer {k}, cost {c}": p.FrontierAssignment(
                p.PairTimer(k, reach), reach, p.UtilityCost(c)
            )
            for k in (4, 5, 6)
            for c in (0.05, 0.1, 0.2)
        },
        "hedac": lambda: {
            f"timer 5, loss {loss}": p.HEDAC(p.PairTimer(5, reach), config, loss)
            for loss in (0.02, 0.05, 0.2)
        },
        "rendezvous": lambda: {
            f"exchange at {[*early, start]} + {period} n, memory {memory}": p.Rendezvous(
                config, p.SharedClock(start, period, reach, early), memory_steps=memory
            )
            for early, start, period, memory in (
                ((), 12, 3, 8),
                ((), 12, 3, 3),
                ((), 9, 4, 8),
                ((8,), 14, 3, 3),
            )
        },
    }
    if planner not in families:
        raise ValueError(f"planner={planner!r} is not one of {list(families)}")
    return families[planner]()


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="tune_planners.py", description=__doc__)


def run(arguments: Arguments) -> None:
    """Evaluate every setting and print a table."""
    from marl_explore import tables
    from marl_explore.evaluation import evaluate

    config = ArenaConfig()
    rows = []
    for name, planner in candidates(arguments.planner, config).items():
        measures = evaluate(
            planner,
            config,
            num_arenas=arguments.num_arenas,
            steps=arguments.steps,
            stream="validation",
        )
        rows.append([name, *(tables.number(measures[key]) for key in MEASURES)])
    print(tables.text(["setting", *MEASURES], rows))


if __name__ == "__main__":
    cli.main(parse, run)
