"""Variants of a training held against a baseline: all seeds of each on the same test arenas."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from marl_explore import tables
from marl_explore.config import TrainConfig, from_json
from marl_explore.evaluation import find_policy, record
from marl_explore.metrics import summarize
from marl_explore.planners import PLANNERS
from marl_explore.policies import load_policy, policy_info
from marl_explore.stats import Estimate, seed_difference, seed_mean

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
"""What is compared (docs/metrics.md), and its column."""
COMPARED = {
    "coverage_at_150": "at 150 - baseline",
    "steps_to_100": "steps to 100 % - baseline",
}
"""What the difference to the baseline is given of, and its column."""
SAME_ARENAS = ("arenas", "height", "width", "obstacle_density", "num_agents")
"""Settings that decide which arenas a policy is tested on."""


class Variant(NamedTuple):
    """One training under several seeds, or a planner."""

    name: str
    policies: tuple[str, ...]
    """One per seed; of a planner its name."""
    config: TrainConfig
    """Of every seed but for the seed; of a planner that of the baseline, whose arenas it meets."""
    settings: Mapping[str, Any]
    """What differs from the baseline; of the baseline itself, from the defaults."""

    @property
    def planner(self) -> bool:
        """Whether it is a planner."""
        return self.policies[0] in PLANNERS


@dataclass(frozen=True)
class Row:
    """What a variant comes to."""

    variant: Variant
    seeds: Mapping[str, Mapping[str, float]]
    """Every measure of every policy, means over arenas."""
    means: Mapping[str, Estimate]
    """``MEASURES`` over seeds; NaN where no seed has the measure."""
    differences: Mapping[str, Estimate]
    """``COMPARED``, minus the baseline's; none for the baseline."""

    def scores(self, measure: str) -> list[float]:
        """A measure of every seed that has it [S]: without communication none is useful."""
        values = [measures[measure] for measures in self.seeds.values()]
        return [value for value in values if math.isfinite(value)]


def find_variants(entries: Mapping[str, Sequence[str]]) -> list[Variant]:
    """What is to be compared, the baseline first.

    Args:
        entries: by name the policies of all seeds, as ``load_policy`` takes them, or one planner.

    Raises:
        ValueError: naming the entry, when a policy cannot be read, seeds of an entry differ in
            more than the seed or come twice, an entry is tested on other arenas than the
            baseline, or the baseline is a planner or missing.
    """
    if not entries:
        raise ValueError("name at least one training, such as case2=runs/case2: the baseline")
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
                    f"{name!r} cannot be compared with {variants[0].name!r}: it meets other "
                    f"arenas, {format_settings(other)}"
                )
        variants.append(Variant(name, tuple(policies), config, settings))
    return variants


def differences(config: TrainConfig, baseline: TrainConfig) -> dict[str, Any]:
    """The fields that differ from the baseline's but for the seed, those of the arena included."""
    fields, others = _flat(config), _flat(baseline)
    return {key: value for key, value in fields.items() if value != others[key]}


def format_settings(settings: Mapping[str, Any]) -> str:
    """Settings in words."""
    return ", ".join(f"{key}={value}" for key, value in settings.items())


def compare(
    variants: Sequence[Variant],
    num_arenas: int,
    steps: int,
    seed: int,
    report: Callable[[str], None] = print,
) -> list[Row]:
    """Evaluate every policy on test arenas; actions are sampled.

    Args:
        variants: those of ``find_variants``.
        num_arenas: test arenas, the same for all policies.
        steps: of every episode; ``MEASURES`` take 300.
        seed: of the arenas and of sampled actions.
        report: called with the name of every policy before it is evaluated.
    """
    rows: list[Row] = []
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


def _row(variant: Variant, seeds: Mapping[str, Mapping[str, float]], baseline: Row | None) -> Row:
    row = Row(variant, seeds, {}, {})
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


def format_markdown(rows: Sequence[Row]) -> str:
    """The comparison as a Markdown table."""
    header = ["", "settings", "seeds", *MEASURES.values(), *COMPARED.values()]
    return tables.markdown(header, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    variant = row.variant
    means = [tables.estimate(*row.means[name]) for name in MEASURES]
    against = [
        tables.estimate(*row.differences[name], sign="+") if row.differences else "-"
        for name in COMPARED
    ]
    seeds = "-" if variant.planner else str(len(row.seeds))
    return [variant.name, _in_words(row), seeds, *means, *against]


def _in_words(row: Row) -> str:
    words = format_settings(row.variant.settings)
    if row.variant.planner:
        return f"planner {row.variant.policies[0]}"
    if not row.differences:
        return f"baseline: {words or 'the defaults'}"
    return words or "as the baseline"


def as_record(row: Row) -> dict[str, Any]:
    """Everything about a row, for JSON; what was not measured is None."""

    def numbers(values: Mapping[str, float]) -> dict[str, float | None]:
        return {name: None if math.isnan(value) else value for name, value in values.items()}

    return {
        "planner": row.variant.planner,
        "settings": dict(row.variant.settings),
        "config": None if row.variant.planner else asdict(row.variant.config),
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
        raise ValueError(f"seeds {seeds} of {name!r} are not allowed: each may come once")
    return configs[0]


def _config(policy: str) -> TrainConfig:
    """What a policy was trained with."""
    if policy in PLANNERS:
        raise ValueError(f"{policy!r} is a planner: the baseline must be a trained policy")
    load_policy(policy)  # says what is wrong with what cannot be read
    try:
        return TrainConfig(**from_json(policy_info(policy)["config"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{policy} has no configuration of this version: {error!r}") from error


def _flat(config: TrainConfig) -> dict[str, Any]:
    fields = asdict(config)
    del fields["seed"]
    return fields.pop("arena") | fields
