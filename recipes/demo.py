"""Train for a few minutes, compare with the planners on arenas never seen, draw what happened.

python recipes/demo.py
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from marl_explore import cli
from marl_explore.config import require_integer
from marl_explore.presets import PRESETS

MARK = "demo.txt"
COMPARED = ("best", "random", "nearest", "nearest-timer", "utility-cost")
"""What the freshly trained policy stands beside: the policy of the package, and planners."""
FILES = ("table.txt", "results.csv", "coverage.png", "episode.gif", "replay.html")


@dataclass(frozen=True)
class Arguments:
    """Where the demonstration goes and how long it takes."""

    out: Path = Path("demo")
    """Folder for the results; an earlier demonstration in it is replaced."""
    seed: int = 0
    """Seed of the training."""
    episodes: int = PRESETS["fast"].episodes
    """Training length (episodes)."""
    num_arenas: int = 200
    """Test arenas."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("threads", self.threads, 1)


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="demo.py", description=__doc__)


def run(arguments: Arguments) -> None:
    """Train, evaluate, draw."""
    import torch

    from marl_explore import metrics, plots, runs
    from marl_explore.evaluation import find_policy, format_table, watch, write_results
    from marl_explore.evaluation import record as record_episodes
    from marl_explore.replay import write_replay

    torch.set_num_threads(arguments.threads)
    config = replace(PRESETS["fast"], seed=arguments.seed, episodes=arguments.episodes)
    # made beside it, so that an earlier demonstration is replaced by a whole one or not at all
    out = arguments.out.resolve()
    folder = out.with_name(out.name + ".unfinished")
    for path in (out, folder):
        if not (path / MARK).exists():
            runs.require_new(path)
    _remove(folder)
    record = runs.provenance()
    folder.mkdir(parents=True)
    (folder / MARK).write_text("made by recipes/demo.py, which may replace this folder\n")

    print(f"training the preset 'fast' on {config.updates * config.batch_frames} steps ...")
    learned = runs.train(config, folder / "training")

    print(f"evaluating on {arguments.num_arenas} test arenas ...")
    policies = {"learned": learned} | {n: find_policy(n, config.arena) for n in COMPARED}
    episodes = {
        name: record_episodes(policy, config.arena, num_arenas=arguments.num_arenas)
        for name, policy in policies.items()
    }
    results = {name: metrics.summarize(recorded) for name, recorded in episodes.items()}
    write_results(folder, results, record)
    plots.coverage_figure(
        {name: metrics.coverage(recorded)["largest"] for name, recorded in episodes.items()},
        folder / "coverage.png",
    )

    watched = {n: watch(policies[n], config.arena, steps=100) for n in ("learned", "best")}
    plots.episode_animation(watched["learned"], folder / "episode.gif")
    write_replay(watched, folder / "replay.html", config=config.arena, about=record["command"])

    _remove(out)
    folder.rename(out)
    print(format_table(results))
    for name in (*FILES, "training"):
        print(arguments.out / name)


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


if __name__ == "__main__":
    cli.main(parse, run)
