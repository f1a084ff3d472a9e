"""The leaderboard as text, Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from marl_explore.evaluation.leaderboard.ranking import Row, title
from marl_explore.utils import tables
from marl_explore.utils.files import atomic_write, write_text


def plain(measure: str) -> Callable[[Row], str]:
    """A column of a measure."""
    return lambda row: tables.number(row.measures.get(measure, math.nan))


def with_interval(measure: str, sign: str = "") -> Callable[[Row], str]:
    """A column of a measure and its interval; with the sign "+" positive numbers have theirs."""

    def cell(row: Row) -> str:
        value, low, high = (row.measures[measure + end] for end in ("", "_low", "_high"))
        return tables.estimate(value, low, high, sign)

    return cell


Columns = Mapping[str, Callable[[Row], str]]
"""What a table shows of a row, by the title of the column."""

COLUMNS: Columns = {
    "policy": lambda row: row.name,
    "sees": lambda row: row.sees,
    "steps to 95 %": plain("steps_to_95"),
    "steps to 100 %": with_interval("steps_to_100"),
    "p90": plain("steps_to_100_p90"),
    "complete": plain("complete"),
    "finishable": plain("finishable"),
    "coverage at 20": plain("coverage_at_20"),
    "at 50": plain("coverage_at_50"),
    "at 150": plain("coverage_at_150"),
    "communicate": plain("communication_share_before_completion"),
    "useful": plain("useful_share"),
    "overlap": plain("overlap"),
    "to best planner": with_interval("difference", sign="+"),
}
"""Columns of the printed table; the CSV and JSON files hold every measure."""

MEANINGS = {
    "steps to 95 %, steps to 100 %": "mean number of steps until the largest map covers that share "
    "of the target cells; if it is not reached, it counts as one more than the steps of an "
    "episode; in brackets the 95 % bootstrap interval over seeds and arenas",
    "p90": "9 of 10 arenas take at most this many steps to 100 %",
    "complete": "share of the arenas in which some map became complete",
    "finishable": "where robots failed, share of the arenas in which those that are left can, at "
    "the end, still complete a map",
    "coverage at 20, 50, 150": "mean coverage of the largest map at that step",
    "communicate": "communicate actions / all actions, before a map is complete",
    "useful": "communicate actions that enlarged the sender's map / communicate actions, until the "
    "map of every robot is complete",
    "overlap": "own discoveries of all robots / cells of the union - 1",
    "to best planner": "steps to 100 % minus those of the fastest planner that is not a reference, "
    "on the same arenas; less than 0 is faster",
    "below the line": "references, which use information that no robot has; sharing costs them "
    "nothing, and the union counts as the map of each robot; bound: no team can take fewer steps",
}
"""The meanings of the columns."""


def columns(rows: Sequence[Row], shown: Columns = COLUMNS) -> Columns:
    """The columns of a suite: without the share of finishable arenas where no robot failed."""
    fail = any(row.measures.get("failed_robots", 0) > 0 for row in rows)
    return {name: cell for name, cell in shown.items() if fail or name != "finishable"}


def blocks(rows: Sequence[Row], shown: Columns = COLUMNS) -> list[list[list[str]]]:
    """The table cells: first the competing rows, then the references."""
    cells = columns(rows, shown).values()
    groups = ([row for row in rows if row.reference is reference] for reference in (False, True))
    return [[[cell(row) for cell in cells] for row in group] for group in groups if group]


def format_text(boards: Sequence[Sequence[Row]], shown: Columns = COLUMNS) -> str:
    """All suites as text."""
    return "\n\n".join(
        f"{title(rows)}\n\n{tables.text([*columns(rows, shown)], *blocks(rows, shown))}\n"
        for rows in boards
    )


def format_markdown(
    boards: Sequence[Sequence[Row]],
    shown: Columns = COLUMNS,
    meanings: Mapping[str, str] = MEANINGS,
) -> str:
    """All suites as Markdown."""
    suites = []
    for rows in boards:
        table = tables.markdown([*columns(rows, shown)], *blocks(rows, shown))
        suites.append(f"## {title(rows)}\n\n{table}\n")
    told = (f"- **{name}**: {meaning}\n" for name, meaning in meanings.items())
    return "\n".join((*suites, "".join(told)))


def write_tables(
    folder: Path,
    boards: Sequence[Sequence[Row]],
    record: Mapping[str, Any],
    shown: Columns = COLUMNS,
    meanings: Mapping[str, str] = MEANINGS,
) -> None:
    """Write table.txt, table.md, table.csv and table.json.

    Args:
        folder: where.
        boards: the rows of each suite.
        record: about the run, kept in table.json.
        shown: columns of the first two.
        meanings: of the columns.
    """
    write_text(folder / "table.txt", format_text(boards, shown))
    write_text(folder / "table.md", format_markdown(boards, shown, meanings))
    records = [_record(row) for rows in boards for row in rows]
    content = {"rows": records, "run": record}
    write_text(folder / "table.json", json.dumps(content, indent=2, default=str) + "\n")
    names = list(dict.fromkeys(name for entry in records for name in entry))
    with atomic_write(folder / "table.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(records)


def _record(row: Row) -> dict[str, Any]:
    about = {
        "suite": row.settings["suite"],
        "policy": row.name,
        "sees": row.sees,
        "planner": row.planner,
        "reference": row.reference,
        "seeds": len(row.results),
        "num_arenas": row.settings["num_arenas"],
        "steps": row.settings["steps"],
    }
    return about | {name: None if math.isnan(x) else x for name, x in row.measures.items()}
