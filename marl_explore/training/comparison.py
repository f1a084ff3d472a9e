"""Variants of training runs compared with a baseline: all seeds on the same test arenas."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from marl_explore.evaluation.episodes import record
from marl_explore.evaluation.metrics import summarize
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.stats import Estimate, seed_difference, seed_mean
from marl_explore.planners import PLANNERS
from marl_explore.policies.io import load_policy, policy_info
from marl_explore.training.config import TrainConfig
from marl_explore.utils import tables

MEASURES = {
    "coverage_at_20": "coverage at 20",
    "coverage_at_150": "at 150",
    "coverage_at_300": "at 300",
    "steps_to_95": "steps to 95 %",
    "steps_to_100": "steps to 100 %",
    "complete": "complete",
    "communication_share": "communicate",
    "useful_share": "useful",
}
"""Measures that are compared (docs/metrics.md), and their columns."""
COMPARED = {
    "coverage_at_150": "at 150 - baseline",
    "steps_to_100": "steps to 100 % - baseline",
}
"""Measures with a difference to the baseline, and their columns."""
SAME_ARENAS = ("arenas", "height", "width", "obstacle_density", "num_agents")
"""Settings that decide which arenas a policy is tested on."""


class Variant(NamedTuple):
    """The training runs of one setting over several seeds, or a planner."""

    name: str
    policies: tuple[str, ...]
    """One policy per seed; for a planner, its name."""
    config: TrainConfig
    """That of every seed, except the seed itself; for a planner, the baseline's."""
    settings: Mapping[str, Any]
    """What differs from the baseline; for the baseline itself, from the defaults."""

    @property
    def planner(self) -> bool:
        """Whether it is a planner."""
        return self.policies[0] in PLANNERS


@dataclass(frozen=True)
class Comparison:
    """The results of a variant."""

    variant: Variant
    seeds: Mapping[str, Mapping[str, float]]
    """Every measure of every policy, means over arenas."""
    means: Mapping[str, Estimate]
    """``MEASURES``, means over seeds; NaN where no seed has the measure."""
    differences: Mapping[str, Estimate]
    """``COMPARED``, minus the baseline's; empty for the baseline."""

    def scores(self, measure: str) -> list[float]:
        """A measure of every seed that has it [S]; seeds that never communicate lack a share."""
        values = [measures[measure] for measures in self.seeds.values()]
        return [value for value in values if math.isfinite(value)]


def find_variants(entries: Mapping[str, Sequence[str]]) -> list[Variant]:
    """The variants to compare, the baseline first.

    Args:
        entries: by name, the policies of all seeds, as ``load_policy`` takes them, or one planner.

    Raises:
        ValueError: naming the entry, when a policy cannot be read, when seeds of an entry differ
            in more than the seed or are given twice, when an entry is tested on other arenas than
            the baseline, or when the baseline is a planner or missing.
    """
    if not entries:
        raise ValueError("name at least one training run, such as case2=runs/case2: the baseline")
    variants: list[Variant] = []
    for name, policies in entries.items():
        if not variants:
            config = _common_config(name, policies)
            settings = differences(config, TrainConfig())
        elif set(policies) & set(PLANNERS):
            if len(policies) > 1:
                raise ValueError(f"{name}={list(policies)} is not allowed: a planner has no seeds")
            config, settings = variants[0].config, {}
        else:
            config = _common_config(name, policies)
            settings = differences(config, variants[0].config)
            other = {key: settings[key] for key in SAME_ARENAS if key in settings}
            if other:
                raise ValueError(
                    f"{name!r} cannot be compared with {variants[0].name!r}: it has other "
                    f"arenas, {format_settings(other)}"
                )
        variants.append(Variant(name, tuple(policies), config, settings))
    return variants


def differences(config: TrainConfig, baseline: TrainConfig) -> dict[str, Any]:
    """The fields that differ from the baseline's, including the arena's but not the seed."""
    fields, others = _flat(config), _flat(baseline)
    if config.network.name != baseline.network.name:  # compare options with the network's defaults
        others |= asdict(type(config.network)())
    return {key: value for key, value in fields.items() if value != others[key]}


def format_settings(settings: Mapping[str, Any]) -> str:
    """Settings as text."""
    return ", ".join(f"{key}={value}" for key, value in settings.items())


def compare(
    variants: Sequence[Variant],
    num_arenas: int,
    steps: int,
    seed: int,
    report: Callable[[str], None] = print,
) -> list[Comparison]:
    """Evaluate every policy on test arenas; actions are sampled.

    Args:
        variants: from ``find_variants``.
        num_arenas: test arenas, the same for all policies.
        steps: of every episode; ``MEASURES`` take 300.
        seed: of the arenas and of sampled actions.
        report: called with the name of every policy before it is evaluated.
    """
    rows: list[Comparison] = []
    for variant in variants:
        seeds = {}
        for policy in variant.policies:
            report(f"{variant.name}: {policy}")
            arena, arenas = variant.config.arena, variant.config.arenas
            actor = find_policy(policy, arena)
            seeds[policy] = summarize(
                record(actor, arena, num_arenas, steps, seed=seed, arenas=arenas)
            )
        rows.append(_row(variant, seeds, rows[0] if rows else None))
    return rows


def _row(
    variant: Variant, seeds: Mapping[str, Mapping[str, float]], baseline: Comparison | None
) -> Comparison:
    row = Comparison(variant, seeds, {}, {})
    means = {name: _estimate(seed_mean, row.scores(name)) for name in MEASURES}
    if baseline is None:
        return replace(row, means=means)
    against = {
        name: _estimate(seed_difference, row.scores(name), baseline.scores(name))
        for name in COMPARED
    }
    return replace(row, means=means, differences=against)


def _estimate(statistic: Callable[..., Estimate], *scores: list[float]) -> Estimate:
    return statistic(*scores) if all(scores) else Estimate(math.nan, math.nan, math.nan)


def format_markdown(rows: Sequence[Comparison]) -> str:
    """The comparison as a Markdown table."""
    header = ["", "settings", "seeds", *MEASURES.values(), *COMPARED.values()]
    return tables.markdown(header, [_cells(row) for row in rows])


def _cells(row: Comparison) -> list[str]:
    variant = row.variant
    means = [tables.estimate(*row.means[name]) for name in MEASURES]
    against = [
        tables.estimate(*row.differences[name], sign="+") if row.differences else "-"
        for name in COMPARED
    ]
    seeds = "-" if variant.planner else str(len(row.seeds))
    return [variant.name, _in_words(row), seeds, *means, *against]


def _in_words(row: Comparison) -> str:
    words = format_settings(row.variant.settings)
    if row.variant.planner:
        return f"planner {row.variant.policies[0]}"
    if not row.differences:
        return f"baseline: {words or 'the defaults'}"
    return words or "same as the baseline"


def as_record(row: Comparison) -> dict[str, Any]:
    """Everything about a row, for JSON; None where nothing was measured."""

    def numbers(values: Mapping[str, float]) -> dict[str, float | None]:
        return {name: None if math.isnan(value) else value for name, value in values.items()}

    return {
        "planner": row.variant.planner,
        "settings": dict(row.variant.settings),
        "config": None if row.variant.planner else row.variant.config.to_json(),
        "seeds": {policy: numbers(measures) for policy, measures in row.seeds.items()},
        "means": {name: numbers(mean._asdict()) for name, mean in row.means.items()},
        "differences": {name: numbers(d._asdict()) for name, d in row.differences.items()},
    }


def _common_config(name: str, policies: Sequence[str]) -> TrainConfig:
    """The configuration that all seeds of an entry share, with the seed of the first."""
    configs = [_config(policy) for policy in policies]
    for policy, config in zip(policies, configs, strict=True):
        other = differences(config, configs[0])
        if other:
            raise ValueError(
                f"seeds of {name!r} differ in more than the seed: {policy} has "
                f"{format_settings(other)}"
            )
    seeds = [config.seed for config in configs]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds {seeds} of {name!r} are not allowed: each may appear only once")
    return configs[0]


def _config(policy: str) -> TrainConfig:
    """What a policy was trained with."""
    if policy in PLANNERS:
        raise ValueError(f"{policy!r} is a planner: the baseline must be a trained policy")
    load_policy(policy)  # raises a helpful error for what cannot be read
    try:
        return TrainConfig.from_json(policy_info(policy)["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{policy} has no configuration of this version: {error!r}") from error


def _flat(config: TrainConfig) -> dict[str, Any]:
    fields = asdict(config) | {"network": config.network.name}
    del fields["seed"]
    return fields.pop("arena") | fields | asdict(config.network)
