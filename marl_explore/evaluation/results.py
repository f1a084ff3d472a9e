"""Measures of policies on test arenas: computed, formatted as a table, and written to files."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation.episodes import Actor, record
from marl_explore.evaluation.metrics import summarize
from marl_explore.utils import tables
from marl_explore.utils.files import atomic_write, write_text


def evaluate(policy: Actor, config: ArenaConfig | None, **options: Any) -> dict[str, float]:
    """The measures of ``metrics.summarize`` for one policy; options as for ``record``."""
    return summarize(record(policy, config, **options))


TABLE_COLUMNS = {
    "steps to 95 %": "steps_to_95",
    "steps to 100 %": "steps_to_100",
    "complete": "complete",
    "finishable": "finishable",
    "coverage at 50": "coverage_at_50",
    "coverage at 150": "coverage_at_150",
    "communicate": "communication_share",
    "useful": "useful_share",
    "overlap": "overlap",
}
"""Columns of the printed table, the share of finishable arenas only where robots failed; the files
hold every measure."""


def format_table(results: dict[str, dict[str, float]]) -> str:
    """A text table of policies by their main measures."""
    fail = any(row.get("failed_robots", 0) > 0 for row in results.values())
    columns = {
        title: key
        for title, key in TABLE_COLUMNS.items()
        if all(key in row for row in results.values()) and (fail or key != "finishable")
    }
    rows = [
        [name, *(tables.number(measures[key]) for key in columns.values())]
        for name, measures in results.items()
    ]
    return tables.text(["policy", *columns], rows)


def write_results(
    folder: Path,
    results: dict[str, dict[str, float]],
    record: dict[str, Any],
    scores: Mapping[str, Mapping[str, Tensor]] | None = None,
) -> None:
    """Write every measure as results.json and results.csv, and the main ones as table.txt.

    Args:
        folder: where.
        results: by policy and measure.
        record: about the run, kept in results.json.
        scores: by policy and measure, the numbers of every arena [B], kept in results.json.
    """
    measures = {n: {k: v if v == v else None for k, v in r.items()} for n, r in results.items()}
    content: dict[str, Any] = {"results": measures, "run": record}
    if scores is not None:
        content["scores"] = {
            name: {key: values.tolist() for key, values in of_policy.items()}
            for name, of_policy in scores.items()
        }
    write_text(folder / "results.json", json.dumps(content, indent=2, default=str) + "\n")
    write_text(folder / "table.txt", format_table(results) + "\n")
    with (
        atomic_write(folder / "results.csv") as unfinished,
        unfinished.open("w", newline="") as file,
    ):
        writer = csv.writer(file)
        names = list(next(iter(results.values())))
        writer.writerow(["policy", *names])
        writer.writerows([policy, *(row[n] for n in names)] for policy, row in results.items())
