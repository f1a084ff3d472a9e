"""Compare trained policies with the paper's claims: a table, and its three evaluation figures.

marl-explore paper mlp-case1=runs/a,runs/b mlp-case2=runs/c cnn-case1=runs/d cnn-case2=runs/e

Each name, of which some may be left out, takes runs of several training seeds, or the folder of a
sweep over seeds. As in the paper, there are 200 random arenas, the same for every policy, 300
steps, and sampled actions. Intervals are 95 % bootstrap intervals over seeds and arenas, and a
claim is also tested in every draw of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer

if TYPE_CHECKING:
    from torch import Tensor

    from marl_explore.evaluation.metrics import Episodes
    from marl_explore.evaluation.stats import Array

STEPS = 300
SPREAD = "spread_at_150"
"""Standard deviation over arenas of the coverage at step 150."""
NAMES = ("mlp-case1", "mlp-case2", "cnn-case1", "cnn-case2")
MEASURES = {
    "coverage_at_20": "coverage at 20",
    "coverage_at_150": "at 150",
    "coverage_at_300": "at 300",
    SPREAD: "deviation at 150",
    "communication_share": "communicate",
    "useful_share": "useful",
    "large_enlargement_share": "merges > e_max",
    "steps_to_100": "steps to 100 %",
}
"""The measures of the claims, and their columns in the table of policies."""


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore paper``."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=RUN,RUN,... or NAME=SWEEP for mlp-case1, mlp-case2, cnn-case1 and cnn-case2; claims
    about a policy that is left out are not tested."""
    num_arenas: int = 200
    """Number of test arenas, the same for every policy."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path = Path("paper")
    """New folder for tables, figures and results.json."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("seed", self.seed, 0)


class Claim(NamedTuple):
    """A claim of the paper, and how it is tested on our numbers."""

    text: str
    measure: str
    holds: Callable[[Mapping[str, float]], bool]
    """From the measure of every policy to whether it agrees with the claim."""
    names: tuple[str, ...] = NAMES
    """The policies that it is about; without one of them it cannot be tested."""


def everywhere(least: float, names: tuple[str, ...] = NAMES) -> Callable[..., bool]:
    """Whether all policies with these names reach a value."""
    return lambda values: all(values[name] >= least for name in names)


def larger(*pairs: tuple[str, ...]) -> Callable[..., bool]:
    """Whether the first policy of every pair has the larger value."""
    return lambda values: all(values[a] > values[b] for a, b in pairs)


CASE_1_OVER_2 = (("mlp-case1", "mlp-case2"), ("cnn-case1", "cnn-case2"))
CASE_2_OVER_1 = tuple(pair[::-1] for pair in CASE_1_OVER_2)
CNN_OVER_MLP = (("cnn-case1", "mlp-case1"), ("cnn-case2", "mlp-case2"))
CLAIMS = (
    Claim("all policies cover at least 80 % after 150 steps", "coverage_at_150", everywhere(0.80)),
    Claim(
        "CNN policies surpass 90 % by the end",
        "coverage_at_300",
        everywhere(0.90, ("cnn-case1", "cnn-case2")),
        ("cnn-case1", "cnn-case2"),
    ),
    Claim(
        "case 2 reaches up to 99 %",
        "coverage_at_300",
        lambda values: max(values["mlp-case2"], values["cnn-case2"]) >= 0.99,
        ("mlp-case2", "cnn-case2"),
    ),
    Claim(
        "arenas lie close around the average (read as: deviation at most 0.1)",
        SPREAD,
        lambda values: max(values.values()) <= 0.1,
    ),
    Claim("case 1 communicates more than case 2", "communication_share", larger(*CASE_1_OVER_2)),
    Claim(
        "communications are more effective with CNN than with MLP",
        "useful_share",
        larger(*CNN_OVER_MLP),
    ),
    Claim(
        "case 1 has larger maps early (read as: step 20)",
        "coverage_at_20",
        larger(*CASE_1_OVER_2),
    ),
    Claim("case 2 has larger maps in the end", "coverage_at_300", larger(*CASE_2_OVER_1)),
    Claim(
        "merges bring more with case 2 (read as: share above e_max)",
        "large_enlargement_share",
        larger(*CASE_2_OVER_1),
    ),
)


def measured(episodes: Episodes) -> dict[str, float]:
    """Every measure of one policy."""
    from marl_explore.evaluation import metrics

    largest = metrics.coverage(episodes)["largest"]
    spread = float(largest[:, 150].std(correction=0))
    return metrics.summarize(episodes) | {SPREAD: spread}


def scores_of(episodes: list[Episodes]) -> dict[str, Array]:
    """What every measure of a policy is computed from, by measure.

    [S, A] of S seeds on A arenas, or [S, A, 2] for the numbers of some events and of all.
    """
    import numpy as np
    import torch

    from marl_explore.evaluation import metrics

    def of_seed(episode: Episodes) -> dict[str, Array]:
        each = metrics.per_episode(episode)
        counts = {name: torch.stack(share, -1) for name, share in metrics.shares(episode).items()}
        scores = {**each, **counts, SPREAD: each["coverage_at_150"]}
        return {measure: scores[measure].numpy() for measure in MEASURES}

    seeds = [of_seed(episode) for episode in episodes]
    return {measure: np.stack([seed[measure] for seed in seeds]) for measure in MEASURES}


def statistic(measure: str, scores: Array) -> float:
    """A measure, the mean over seeds; NaN if no seed has any of the events."""
    import numpy as np

    if scores.ndim == 3:
        part, whole = scores.sum(1).T
        some = whole > 0
        return float((part[some] / whole[some]).mean()) if some.any() else np.nan
    of_seeds = scores.std(1) if measure == SPREAD else scores.mean(1)
    return float(of_seeds.mean())


def claims_table(episodes: Mapping[str, list[Episodes]]) -> str:
    """The paper's claims, our numbers with intervals, and whether they agree.

    The last column is the share of bootstrap draws in which a claim holds.
    """
    from marl_explore.evaluation import stats
    from marl_explore.utils import tables

    rows, of_policies = [], {name: scores_of(seeds) for name, seeds in episodes.items()}
    for claim in CLAIMS:
        scores = {name: of_policy[claim.measure] for name, of_policy in of_policies.items()}
        of = partial(statistic, claim.measure)
        values = {name: of(sample) for name, sample in scores.items()}
        draws = stats.joint_draws(scores, dict.fromkeys(scores, of))
        cells = []
        for name, value in values.items():
            low, high = map(tables.number, stats.bounds(draws[name]))
            cells.append(f"{tables.number(value)} [{low}, {high}]")
        verdict, share = "not tested", "-"
        if set(claim.names) <= set(values):
            verdict = "yes" if claim.holds(values) else "no"
            each = zip(*draws.values(), strict=True)
            held = [bool(claim.holds(dict(zip(draws, drawn, strict=True)))) for drawn in each]
            share = tables.number(sum(held) / len(held))
        rows.append([claim.text, *cells, verdict, share])
    return tables.markdown(["the paper", *episodes, "agrees", "in draws"], rows)


def policies_table(seeds: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """The measures of every trained policy."""
    from marl_explore.utils import tables

    rows = [
        [name, Path(run).name, *(tables.number(measures[key]) for key in MEASURES)]
        for name, runs in seeds.items()
        for run, measures in runs.items()
    ]
    return tables.markdown(["policy", "run", *MEASURES.values()], rows)


def draw(episodes: Mapping[str, list[Episodes]], folder: Path) -> None:
    """The paper's three figures, over all seeds of each policy."""
    import torch

    from marl_explore.evaluation import metrics, plots

    def pooled(measure: Callable[[Episodes], Tensor]) -> dict[str, Tensor]:
        return {name: torch.cat([measure(e) for e in parts]) for name, parts in episodes.items()}

    plots.coverage_figure(pooled(lambda e: metrics.coverage(e)["largest"]), folder / "coverage.png")
    share = {
        name: {
            key: torch.cat([metrics.shares(e)[key].each for e in parts])
            for key in ("communication_share", "useful_share")
        }
        for name, parts in episodes.items()
    }
    plots.communication_figure(share, folder / "communication.png")
    max_discovery = next(iter(episodes.values()))[0].max_discovery
    plots.enlargement_figure(
        pooled(metrics.enlargements), max_discovery, folder / "enlargements.png"
    )


def read_entries(words: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The runs of each of the four policies that is named, in the order of ``NAMES``.

    Raises:
        ValueError: when a name is not one of the four, none is given, a policy is given twice for
            the same name, or a sweep is not finished.
    """
    from marl_explore.evaluation.leaderboard import parse_entries
    from marl_explore.training.seeds import seed_runs

    entries = {entry.name: entry.policies for entry in parse_entries(words)}
    if not entries or not set(entries) <= set(NAMES):
        raise ValueError(f"policies={sorted(entries)} is not allowed: name some of {NAMES}")
    seeds = {name: tuple(seed_runs(*entries[name])) for name in NAMES if name in entries}
    for name, policies in seeds.items():
        if len(set(policies)) < len(policies):
            raise ValueError(f"{name}={list(policies)} is not allowed: each may appear only once")
    return seeds


def play(policy: str, arguments: Arguments) -> Episodes:
    """The test episodes of one trained policy, in arenas like those of its training."""
    from marl_explore.evaluation.episodes import record
    from marl_explore.evaluation.registry import find_policy, training_arenas

    arena, arenas = training_arenas(policy)
    return record(
        find_policy(policy, arena),
        arena,
        num_arenas=arguments.num_arenas,
        steps=STEPS,
        seed=arguments.seed,
        arenas=arenas,
    )


def run(arguments: Arguments) -> None:
    """Evaluate all runs; write tables and figures."""
    from marl_explore.utils import records
    from marl_explore.utils.files import write_text

    entries = read_entries(arguments.policies)
    settings = asdict(arguments) | {"out": str(arguments.out)}
    how = records.provenance() | {"settings": settings}
    records.require_new(arguments.out)
    episodes = {n: [play(policy, arguments) for policy in entries[n]] for n in entries}
    seeds = {
        n: {p: measured(e) for p, e in zip(entries[n], episodes[n], strict=True)} for n in entries
    }
    folder = records.new_folder(arguments.out)
    tables = {"claims.md": claims_table(episodes), "policies.md": policies_table(seeds)}
    for file, table in tables.items():
        write_text(folder / file, table + "\n")
        print(table, end="\n\n")
    draw(episodes, folder)
    records.write_json(folder / "results.json", how | {"results": seeds})
    print(f"tables, figures and all measures: {folder}")


def parse(words: Sequence[str], prog: str = "marl-explore paper") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)
