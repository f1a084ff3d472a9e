"""Teams of unlike robots: HAPPO with an actor per type, MAPPO with one for all, and IPPO.

python recipes/mixed_teams.py --algorithms happo mappo ippo --seeds 0-4
python recipes/mixed_teams.py --algorithms happo simultaneous fixed --seeds 0-2
python recipes/mixed_teams.py --team three-types --algorithms happo mappo --seeds 0-2

All learn from as many steps in the same arenas of 16 x 16 cells (in larger ones nothing was learned
from so few), with the networks and settings of the preset ``best`` but a gamma of 0.95, and start
from its untrained utility. MAPPO's actor reads the sensor of the robot that it acts for.
"simultaneous" and "fixed" are HAPPO without its factor, and in one order of actors. A run that is
there already is not trained again, and one that was stopped is resumed; so several processes can
share the work, each with algorithms or seeds of its own. At the end all are measured on test arenas
of that size and of 32 x 32 cells.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marl_explore import (
    PRESETS,
    ArenaConfig,
    Goals,
    RunConfig,
    TrainConfig,
    default_config,
    default_steps,
    find_policy,
    metrics,
    parse_options,
    parse_seeds,
    plots,
    record,
    records,
    require_integer,
    resume,
    run_program,
    stats,
    tables,
    train,
)
from marl_explore.utils.curves import read_curve

Array = NDArray[np.float64]

SMALL, LARGE = 16, 32
"""Sides of the arenas of training, and of the larger ones of the test (cells)."""
UNLIKE = ArenaConfig(
    height=LARGE,
    width=LARGE,
    sensing_shape="disc",
    line_of_sight=True,
    wall_loss_db=math.inf,
)
TEAMS: Mapping[str, tuple[str, ArenaConfig]] = {
    "mixed-team-32": ("mixed-team-32", default_config("mixed-team-32")),
    "one-mapper": (
        "mixed",
        replace(
            UNLIKE,
            sensing_range=(1.5, 1.5, 1.5, 4.0),
            communication_range=(4.0, 4.0, 4.0, 8.0),
            move_period=(1, 1, 1, 2),
        ),
    ),
    "three-types": (
        "mixed",
        replace(
            UNLIKE,
            num_agents=6,
            sensing_range=(1.0, 1.0, 2.5, 2.5, 4.0, 4.0),
            communication_range=(4.0, 4.0, 6.0, 6.0, 8.0, 8.0),
            move_period=(1, 1, 1, 1, 2, 2),
        ),
    ),
}
"""Large arenas, and robots: two scouts and two slow mappers that see far; three scouts and one
mapper; two each of three types."""
ALGORITHMS: Mapping[str, Mapping[str, Any]] = {
    "happo": {"algorithm": "happo", "actors": "type"},
    "mappo": {"algorithm": "mappo"},
    "ippo": {"algorithm": "ippo"},
    "simultaneous": {"algorithm": "happo", "actors": "type", "update_order": "simultaneous"},
    "fixed": {"algorithm": "happo", "actors": "type", "update_order": "fixed"},
}
PLANNER = "goal-utility"
CURVE = "validation_steps_to_100"
FACTOR: Sequence[tuple[str, Callable[[Array], float]]] = (
    ("factor_ess", lambda values: float(values.min())),
    ("factor_min", lambda values: float(values.min())),
    ("factor_max", lambda values: float(values.max())),
)
"""What is told of HAPPO's factor: the extremes over all updates of a run."""
Team = Literal["mixed-team-32", "one-mapper", "three-types"]
Algorithm = Literal["happo", "mappo", "ippo", "simultaneous", "fixed"]


@dataclass(frozen=True)
class Settings:
    """Options of this recipe."""

    team: Team = "mixed-team-32"
    """Robots and their arenas."""
    algorithms: tuple[Algorithm, ...] = ("happo", "mappo", "ippo")
    """What to train, and to compare to the first."""
    seeds: str = "0-4"
    """Training seeds: 0-4 or 0,3."""
    episodes: int = 1067
    """Length of every training, in episodes of 150 steps."""
    num_envs: int = 64
    """Arenas that are stepped side by side."""
    validation_arenas: int = 256
    """Validation arenas, every 25 updates."""
    num_arenas: int = 120
    """Test arenas of each size, the same for all policies."""
    out: Path = Path("mixed-teams")
    """Folder of the runs, of tables.md, curves.png and results.json."""

    def __post_init__(self) -> None:
        """Check the options."""
        for name in ("episodes", "num_envs", "validation_arenas", "num_arenas"):
            require_integer(name, getattr(self, name), 1)
        parse_seeds(self.seeds)

    @property
    def places(self) -> dict[str, tuple[str, ArenaConfig]]:
        """Arenas and robots of training, and of the larger test, by name."""
        kind, robots = TEAMS[self.team]
        small = replace(robots, height=SMALL, width=SMALL)
        return {f"{SMALL} x {SMALL}": ("mixed", small), f"{LARGE} x {LARGE}": (kind, robots)}

    def config(self, algorithm: str, seed: int) -> TrainConfig:
        """The training of one algorithm with one seed."""
        arenas, robots = next(iter(self.places.values()))
        network = Goals(
            prior=5.0,
            home_cells=LARGE * LARGE,
            reads_sensor=algorithm == "mappo",
        )
        return replace(
            PRESETS["best"],
            arenas=arenas,
            arena=robots,
            gamma=0.95,
            scenes=(),
            network=network,
            episodes=self.episodes,
            episode_steps=150,
            num_envs=self.num_envs,
            rollout_steps=25,
            seed=seed,
            **ALGORITHMS[algorithm],
        )

    def folder(self, algorithm: str, seed: int) -> Path:
        """The run folder of one training."""
        return self.out / self.team / algorithm / f"seed-{seed}"


def main(settings: Settings) -> None:
    """Train what is not there yet, then measure and compare."""
    seeds = parse_seeds(settings.seeds)
    for seed in seeds:
        for algorithm in settings.algorithms:
            _train(settings, algorithm, seed)
    runs: dict[str, list[Path]] = {
        name: [settings.folder(name, seed) for seed in seeds] for name in settings.algorithms
    }
    results: dict[str, dict[str, Any]] = {
        name: measured(settings, folders) for name, folders in runs.items()
    }
    planner = _steps(settings, PLANNER)
    text = "\n\n".join(
        f"{place} cells:\n\n{tabulate(results, place, planner[place])}" for place in settings.places
    )
    folder = settings.out / settings.team
    (folder / "tables.md").write_text(text + "\n")
    shown = {CURVE: "steps to a complete map (validation)", "factor_ess": "ESS of the factor"}
    plots.training_figure(runs, folder / "curves.png", shown)
    content = {
        "team": settings.team,
        "seeds": seeds,
        "results": results,
        PLANNER: planner,
    }
    records.write_json(folder / "results.json", records.provenance() | content)
    print(f"{text}\n\nruns, tables, curves and results: {folder}")


def _train(settings: Settings, algorithm: str, seed: int) -> None:
    config, folder = settings.config(algorithm, seed), settings.folder(algorithm, seed)
    if (folder / "policy.safetensors").exists():
        return
    print(f"{folder}: {config.updates} updates", flush=True)
    if (folder / "config.json").exists():
        resume(folder)
    else:
        run = RunConfig(validate_every=25, validation_arenas=settings.validation_arenas)
        train(config, folder, run)


def measured(settings: Settings, folders: Sequence[Path]) -> dict[str, Any]:
    """Of every seed: steps on all test arenas of each size, the curve, and the factor."""
    curves = [read_curve(folder / "scalars" / f"{CURVE}.csv") for folder in folders]
    each = [_steps(settings, str(folder)) for folder in folders]
    return {
        "steps_to_100": {place: [one[place] for one in each] for place in settings.places},
        CURVE: [curve.tolist() for curve in curves],
        **{
            name: [extreme(_values(folder, name)) for folder in folders] for name, extreme in FACTOR
        },
    }


def _values(folder: Path, name: str) -> Array:
    return read_curve(folder / "scalars" / f"{name}.csv")[:, 1]


def _steps(settings: Settings, policy: str) -> dict[str, list[float]]:
    """Steps to a complete map on every test arena, by size."""
    found = {}
    for place, (arenas, robots) in settings.places.items():
        acting = find_policy(policy, robots)
        number, steps = settings.num_arenas, default_steps(arenas)
        episodes = record(acting, robots, number, steps, arenas=arenas, until_mapped=True)
        found[place] = metrics.per_episode(episodes)["steps_to_100"].tolist()
    return found


def tabulate(results: Mapping[str, Mapping[str, Any]], place: str, planner: Sequence[float]) -> str:
    """Mean steps with 95 % intervals over seeds and arenas, differences in pairs, and the factor.

    Args:
        results: ``measured`` by algorithm; the first is the one to which others are compared.
        place: size of the test arenas.
        planner: steps of the planner on them.
    """
    rivals = {PLANNER: np.array([planner])}
    rivals |= {name: np.array(found["steps_to_100"][place]) for name, found in results.items()}
    first = next(iter(results))
    header = ["", "steps to 100 %", f"to {first}", f"to {PLANNER}", "ESS of the factor"]
    rows = []
    for name, steps in rivals.items():
        mean = stats.interval(steps, lambda x: float(x.mean()))
        against = [
            _difference(steps, rivals[other]) if other != name else "-"
            for other in (first, PLANNER)
        ]
        least = results[name]["factor_ess"] if name in results else []
        factor = f"{min(least):.3f}" if any(ess < 1 for ess in least) else "-"
        rows.append([name, tables.estimate(*mean), *against, factor])
    return tables.markdown(header, rows)


def _difference(steps: Array, others: Array) -> str:
    return tables.estimate(*stats.paired_difference(steps, others), "+")


if __name__ == "__main__":
    run_program(
        lambda: parse_options(Settings, sys.argv[1:], Path(sys.argv[0]).name, __doc__), main
    )
