"""Train for a few minutes, compare with the planners on unseen arenas, and draw an episode.

marl-explore demo
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer, require_threads
from marl_explore.training.presets import PRESETS

MARK = "demo.txt"
COMPARED = ("best", "random", "nearest", "nearest-timer", "utility-cost")
"""What the newly trained policy is compared with: the bundled policy, and planners."""
FILES = ("table.txt", "results.csv", "coverage.png", "episode.gif", "replay.html")


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore demo``."""

    out: Path = Path("demo")
    """Folder for the results; an earlier demo in it is replaced."""
    seed: int = 0
    """Seed of the training run."""
    episodes: int = PRESETS["fast"].episodes
    """Length of training (episodes)."""
    num_arenas: int = 200
    """Number of test arenas."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_threads(self.threads)


def parse(words: Sequence[str], prog: str = "marl-explore demo") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Train, evaluate, draw."""
    import torch

    from marl_explore.evaluation import metrics, plots
    from marl_explore.evaluation.episodes import record as record_episodes
    from marl_explore.evaluation.episodes import watch
    from marl_explore.evaluation.registry import find_policy
    from marl_explore.evaluation.replay import write_replay
    from marl_explore.evaluation.results import format_table, write_results
    from marl_explore.training import runs
    from marl_explore.utils import records

    torch.set_num_threads(arguments.threads)
    config = replace(PRESETS["fast"], seed=arguments.seed, episodes=arguments.episodes)
    # made next to it, so that an earlier demo is replaced by a complete one or not at all
    out = arguments.out.resolve()
    folder = out.with_name(out.name + ".unfinished")
    for path in (out, folder):
        if not (path / MARK).exists():
            records.require_new(path)
    _remove(folder)
    record = records.provenance()
    folder.mkdir(parents=True)
    (folder / MARK).write_text("made by marl-explore demo, which may replace this folder\n")

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
