"""BenchMARL's algorithms, and HAPPO as one of them, on the exploration task.

python recipes/benchmarl_exploration.py --algorithms mappo happo

Needs BenchMARL in addition to this package; docs/happo.md ("In BenchMARL") says how to install it.
"""

from __future__ import annotations

import csv
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from marl_explore import (
    parse_options,
    records,
    require_integer,
    require_package,
    run_program,
    tables,
)

Algorithm = Literal["mappo", "ippo", "qmix", "happo"]


@dataclass(frozen=True)
class Arguments:
    """What to train, and for how long."""

    algorithms: tuple[Algorithm, ...] = get_args(Algorithm)
    """Algorithms to train, one after the other."""
    iterations: int = 100
    """Number of batches of 3200 steps of single arenas."""
    seed: int = 0
    """Seed of arenas, networks and actions."""
    out: Path | None = None
    """New folder for BenchMARL's logs; default: runs/ followed by the time."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("iterations", self.iterations, 1)
        require_integer("seed", self.seed, 0)
        if not self.algorithms:
            raise ValueError("algorithms=() is not allowed: name at least one")


SETTINGS = {
    "lr": 5e-4,
    "gamma": 0.95,
    "max_n_frames": None,
    "on_policy_collected_frames_per_batch": 3200,
    "on_policy_n_envs_per_worker": 32,
    "on_policy_n_minibatch_iters": 5,
    "on_policy_minibatch_size": 1600,
    "off_policy_collected_frames_per_batch": 3200,
    "off_policy_n_envs_per_worker": 32,
    "off_policy_n_optimizer_steps": 50,
    "off_policy_memory_size": 50_000,
    "exploration_anneal_frames": 160_000,
    "loggers": ["csv"],
    "evaluation": False,
    "create_json": False,
}
"""Settings that differ from BenchMARL's defaults."""


def returns(name: Algorithm, arguments: Arguments, folder: Path) -> list[float]:
    """Train one algorithm; returns the mean return of the episodes that ended in each batch."""
    from marl_explore import ExplorationTask, HappoConfig  # isort: skip
    from benchmarl.algorithms import algorithm_config_registry
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models import MlpConfig

    config = ExperimentConfig.get_from_yaml()
    changes = {"max_n_iters": arguments.iterations, "save_folder": str(folder)}
    for key, value in (SETTINGS | changes).items():
        getattr(config, key)  # names change between versions
        setattr(config, key, value)
    experiment = Experiment(
        task=ExplorationTask({"reward": "team", "fpr": "proximity", "max_steps": 50}),
        algorithm_config={**algorithm_config_registry, "happo": HappoConfig}[name].get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        critic_model_config=MlpConfig.get_from_yaml(),
        seed=arguments.seed,
        config=config,
    )
    experiment.run()
    (file,) = experiment.folder_name.rglob("collection_reward_episode_reward_mean.csv")
    return [float(value) for _, value in csv.reader(file.read_text().splitlines())]


def run(arguments: Arguments) -> None:
    """Train every algorithm and print the return of the first and the last tenth of the batches."""
    require_package("benchmarl", 'docs/happo.md ("In BenchMARL") says how to install it')
    warnings.filterwarnings("ignore")  # BenchMARL's, about newer versions of its dependencies
    folder = records.new_folder(arguments.out or Path("runs") / time.strftime("%Y%m%d-%H%M%S"))
    tenth = max(1, arguments.iterations // 10)
    results, rows = {}, []
    for name in arguments.algorithms:
        start = time.perf_counter()
        results[name] = curve = returns(name, arguments, folder)
        ends = [sum(part) / tenth for part in (curve[:tenth], curve[-tenth:])]
        rows.append([name, *map(tables.number, ends), f"{time.perf_counter() - start:.0f}"])
    records.write_json(
        folder / "run.json", {"returns": results, "seed": arguments.seed, **records.provenance()}
    )
    print(tables.text(["algorithm", "first", "last", "seconds"], rows))
    print(f"BenchMARL's logs: {folder}")


if __name__ == "__main__":
    run_program(
        lambda: parse_options(Arguments, sys.argv[1:], Path(sys.argv[0]).name, __doc__),
        run,
    )
