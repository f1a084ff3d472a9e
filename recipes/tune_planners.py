"""Compare settings of the planners on validation arenas; PLANNERS has the best ones.

python recipes/tune_planners.py utility-cost

python recipes/tune_planners.py rendezvous --rules "clock 8, 14 + 3 n" "timer 5"

Every setting of a planner is compared under every communication rule. Copy this file and change
the settings: nothing here uses the test arenas.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import tyro

from marl_explore import ArenaConfig, parse_options, require_integer, run_program

if TYPE_CHECKING:
    from marl_explore import CommunicationRule, Planner

MEASURES = (
    "steps_to_95",
    "steps_to_100",
    "complete",
    "communication_share_before_completion",
    "useful_share_before_completion",
)
REFERENCES = ("central", "clairvoyant")
"""Planners that never communicate."""


@dataclass(frozen=True)
class Arguments:
    """Which planner to tune, on how many arenas."""

    planner: Annotated[str, tyro.conf.Positional]
    """Any planner except random, which has no settings."""
    rules: tuple[str, ...] = ()
    """Communication rules, such as "timer 5"; default: all."""
    num_arenas: int = 100
    """Number of validation arenas, of the paper's size."""
    steps: int = 120
    """Length of every episode in steps."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("steps", self.steps, 1)


def rules() -> dict[str, CommunicationRule]:
    """The communication rules to compare, by name."""
    from marl_explore import planners as p

    clocks = (((), 12, 3), ((), 9, 4), ((8,), 14, 3), ((8,), 13, 3), ((7, 11), 15, 2))
    return {
        "never": p.never,
        **{f"timer {k}": p.PairTimer(k) for k in (4, 5, 6, 8)},
        **{f"gain {cells}": p.GainThreshold(cells) for cells in (5, 10, 20)},
        **{
            f"clock {', '.join(map(str, (*early, start)))} + {period} n": p.SharedClock(
                start, period, early
            )
            for early, start, period in clocks
        },
    }


def families(config: ArenaConfig) -> dict[str, Callable[[CommunicationRule], dict[str, Planner]]]:
    """For every planner, a function from a rule to the settings to compare, by name."""
    from marl_explore import planners as p

    def auctions(rule: CommunicationRule, by_number: bool) -> dict[str, Planner]:
        return {
            f"cost {cost}": p.FrontierAssignment(
                rule, assign=p.UtilityCost(cost, by_number=by_number)
            )
            for cost in (0.05, 0.1, 0.2)
        }

    searches = {
        f"beams {width}, discount {discount}": p.BeamSearch(width=width, discount=discount)
        for width, discount in ((24, 0.95), (48, 0.95), (24, 0.9))
    }
    return {
        "nearest": lambda rule: {"": p.NearestFrontier(rule)},
        "nearest-timer": lambda rule: {"": p.NearestFrontier(rule)},
        "fpr-greedy": lambda rule: {"": p.FPRGreedy(rule)},
        "utility-cost": partial(auctions, by_number=False),
        "sequential": partial(auctions, by_number=True),
        "hungarian": lambda rule: {"": p.FrontierAssignment(rule, assign=p.hungarian)},
        "hedac": lambda rule: {
            f"loss {loss}": p.HEDAC(rule, config, loss) for loss in (0.02, 0.05, 0.2)
        },
        "rendezvous": lambda rule: {
            f"memory {memory}, {name}": p.Rendezvous(config, rule, search, memory_steps=memory)
            for memory in (3, 8)
            for name, search in searches.items()
        },
        "central": lambda rule: {n: p.Central(config, search) for n, search in searches.items()},
        "clairvoyant": lambda rule: {
            n: p.Clairvoyant(config, search) for n, search in searches.items()
        },
    }


def candidates(arguments: Arguments, config: ArenaConfig) -> dict[str, Planner]:
    """The settings of a planner to compare, by name."""
    known, settings = rules(), families(config)
    if arguments.planner not in settings:
        raise ValueError(f"planner={arguments.planner!r} is not one of {list(settings)}")
    chosen = arguments.rules or (("never",) if arguments.planner in REFERENCES else tuple(known))
    for name in chosen:
        if name not in known:
            raise ValueError(f"rules={name!r} is not one of {list(known)}")
    return {
        ", ".join(filter(None, (rule, setting))): planner
        for rule in chosen
        for setting, planner in settings[arguments.planner](known[rule]).items()
    }


def parse() -> Arguments:
    """Parse the command line."""
    return parse_options(Arguments, sys.argv[1:], "tune_planners.py", __doc__)


def run(arguments: Arguments) -> None:
    """Evaluate every setting, and print a table."""
    from marl_explore import evaluate, tables

    config = ArenaConfig()
    rows = []
    for name, planner in candidates(arguments, config).items():
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
    run_program(parse, run)
