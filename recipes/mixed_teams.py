"""Teams of unlike robots: HAPPO with an actor per type, MAPPO with one for all, and IPPO.

python recipes/mixed_teams.py --algorithms happo mappo ippo --seeds 0-4
python recipes/mixed_teams.py --algorithms happo simultaneous fixed --seeds 0-2
python recipes/mixed_teams.py --team three-types --algorithms happo mappo --seeds 0-2

All have the same steps of arenas, networks and settings of the preset ``best``, and start from its
untrained utility. MAPPO's actor reads the sensor of the robot that it acts for. "simultaneous" and
"fixed" are HAPPO without its factor, and in one order of actors. A run that is there already is not
trained again, and one that was stopped is resumed; so several processes can share the work, each
with algorithms or seeds of its own. At the end all are measured on test arenas.
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

UNLIKE = ArenaConfig(
    height=24,
    width=24,
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
"""Kind of arenas and robots: two scouts and two slow mappers that see far; three scouts and a
mapper; and two each of three types."""
ALGORITHMS: Mapping[str, Mapping[str, Any]] = {
    "happo": {"algorithm": "happo", "actors": "type"},
    "mappo": {"algorithm": "mappo"},
    "ippo": {"algorithm": "ippo"},
    "simultaneous": {"algorithm": "happo", "actors": "type", "update_order": "simultaneous"},
    "fixed": {"algorithm": "happo", "actors": "type", "update_order": "fixed"},
}
BASELINE = "mappo"
"""Algorithm to which the others are compared."""
RUN = RunConfig(validate_every=50, validation_arenas=32)
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
    """What to train and compare."""
    seeds: str = "0-4"
    """Training seeds: 0-4 or 0,3."""
    episodes: int = 1334
    """Length of every training, in episodes of 300 steps."""
    num_envs: int = 64
    """Arenas that are stepped side by side."""
    num_arenas: int = 120
    """Test arenas, the same for all policies."""
    out: Path = Path("mixed-teams")
    """Folder of the runs, of table.md, curves.png and results.json."""

    def __post_init__(self) -> None:
        """Check the options."""
        for name in ("episodes", "num_envs", "num_arenas"):
            require_integer(name, getattr(self, name), 1)
        parse_seeds(self.seeds)

    def config(self, algorithm: str, seed: int) -> TrainConfig:
        """The training of one algorithm with one seed."""
        arenas, robots = TEAMS[self.team]
        network = Goals(
            prior=5.0,
            home_cells=robots.num_cells,
            reads_sensor=algorithm == "mappo",
        )
        return replace(
            PRESETS["best"],
            arenas=arenas,
            arena=robots,
            scenes=(),
            network=network,
            episodes=self.episodes,
            episode_steps=300,
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
            _train(settings.config(algorithm, seed), settings.folder(algorithm, seed))
    runs: dict[str, list[Path]] = {
        name: [settings.folder(name, seed) for seed in seeds] for name in settings.algorithms
    }
    results: dict[str, dict[str, Any]] = {
        name: measured(settings, folders) for name, folders in runs.items()
    }
    planner = _steps(settings, PLANNER)
    table = tabulate(results, planner)
    place = settings.out / settings.team
    (place / "table.md").write_text(table + "\n")
    shown = {CURVE: "steps to a complete map (validation)", "factor_ess": "ESS of the factor"}
    plots.training_figure(runs, place / "curves.png", shown)
    content = {
        "team": settings.team,
        "seeds": seeds,
        "results": results,
        PLANNER: planner.tolist(),
    }
    records.write_json(place / "results.json", records.provenance() | content)
    print(f"{table}\n\nruns, table, curves and results: {place}")


def _train(config: TrainConfig, folder: Path) -> None:
    if (folder / "policy.safetensors").exists():
        return
    print(f"{folder}: {config.updates} updates", flush=True)
    if (folder / "config.json").exists():
        resume(folder)
    else:
        train(config, folder, RUN)


def measured(settings: Settings, folders: Sequence[Path]) -> dict[str, Any]:
    """Of every seed: steps on all test arenas, the curve of validation, and the factor."""
    curves = [read_curve(folder / "scalars" / f"{CURVE}.csv") for folder in folders]
    return {
        "steps_to_100": [_steps(settings, str(folder)).tolist() for folder in folders],
        CURVE: [curve.tolist() for curve in curves],
        **{
            name: [extreme(_values(folder, name)) for folder in folders] for name, extreme in FACTOR
        },
    }


def _values(folder: Path, name: str) -> Array:
    return read_curve(folder / "scalars" / f"{name}.csv")[:, 1]


def _steps(settings: Settings, policy: str) -> Array:
    """Steps to a complete map on every test arena, [A]."""
    arenas, robots = TEAMS[settings.team]
    acting = find_policy(policy, robots)
    number, steps = settings.num_arenas, default_steps(arenas)
    episodes = record(acting, robots, number, steps, arenas=arenas, until_mapped=True)
    return metrics.per_episode(episodes)["steps_to_100"].numpy()


def tabulate(results: Mapping[str, Mapping[str, Any]], planner: Array) -> str:
    """Mean steps with 95 % intervals over seeds and arenas, differences in pairs, and the factor.

    Args:
        results: ``measured`` by algorithm.
        planner: steps of the untrained planner, [A].
    """
    rivals = {PLANNER: planner[None]}
    rivals |= {name: np.array(found["steps_to_100"]) for name, found in results.items()}
    header = ["", "steps to 100 %", f"to {BASELINE}", f"to {PLANNER}", "ESS of the factor"]
    rows = []
    for name, steps in rivals.items():
        mean = stats.interval(steps, lambda x: float(x.mean()))
        against = [
            _difference(steps, rivals[other]) if other in rivals and other != name else "-"
            for other in (BASELINE, PLANNER)
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
