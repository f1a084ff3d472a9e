"""The leaderboard as one self-contained HTML file with its figures."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
import torch

from marl_explore.evaluation import plots
from marl_explore.evaluation.leaderboard.ranking import Row, title
from marl_explore.evaluation.leaderboard.table import MEANINGS, blocks, columns
from marl_explore.evaluation.stats import Band
from marl_explore.utils.files import write_text

CAPTIONS = {
    "coverage": "Coverage of the largest map over steps",
    "communication": "How much robots communicate, and how much of it is useful, per arena: mean, "
    "middle half (thick), 5 to 95 % (thin)",
    "enlargements": "Cells that merges add to maps; right of the line, more than any move can "
    "discover",
    "tradeoff": "Coverage against the number of cells sent",
}


def write_report(path: str | Path, boards: Sequence[Sequence[Row]], about: str = "") -> Path:
    """Write tables and figures as one HTML file that opens from disk in any browser.

    Args:
        path: file to write; an earlier one is replaced.
        boards: the rows of each suite.
        about: a line under the title, such as the command that made the report.
    """
    meanings = (
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in MEANINGS.items()
    )
    order = [row.name for row in boards[0]]  # an entry has the same colour on every suite
    page = Template(_asset("report.html")).substitute(
        about=escape(about),
        style=_asset("report.css"),
        sections="\n".join(_section(rows, order) for rows in boards),
        meanings="\n".join(meanings),
    )
    path = Path(path)
    write_text(path, page)
    return path


def _section(rows: Sequence[Row], order: Sequence[str]) -> str:
    in_order = sorted((row for row in rows if row.played), key=lambda row: order.index(row.name))
    figures = (
        f'<figure><img alt="{escape(CAPTIONS[name])}" src="{source}">'
        f"<figcaption>{escape(CAPTIONS[name])}</figcaption></figure>"
        for name, source in _figures(in_order).items()
    )
    return (
        f"<section><h2>{escape(title(rows))}</h2>{_table(rows)}"
        f'<div class="figures">{"".join(figures)}</div></section>'
    )


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in columns(rows))
    bodies = (f"<tbody>{''.join(map(_line, block))}</tbody>" for block in blocks(rows))
    return (
        '<div class="wide" tabindex="0" role="region" aria-label="table">'
        f"<table><thead><tr>{head}</tr></thead>{''.join(bodies)}</table></div>"
    )


def _line(cells: Sequence[str]) -> str:
    name, sees, *numbers = map(escape, cells)
    return (
        f'<tr><th scope="row">{name}</th><td class="words">{sees}</td>'
        f"{''.join(f'<td>{number}</td>' for number in numbers)}</tr>"
    )


def _figures(rows: Sequence[Row]) -> dict[str, str]:
    """The figures of a suite as data URLs; none if there are no rows."""
    if not rows:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        plots.coverage_figure({r.name: _coverage(r) for r in rows}, place / "coverage.svg")
        plots.communication_figure({r.name: _shares(r) for r in rows}, place / "communication.svg")
        plots.enlargement_figure(
            {r.name: _enlargements(r) for r in rows},
            rows[0].results[0]["max_discovery"],
            place / "enlargements.svg",
        )
        plots.tradeoff_figure({r.name: _tradeoff(r) for r in rows}, place / "tradeoff.svg")
        return {
            name: "data:image/svg+xml;base64,"
            + base64.b64encode((place / f"{name}.svg").read_bytes()).decode()
            for name in CAPTIONS
        }


def _coverage(row: Row) -> Band:
    """Mean over seeds of each seed's mean and quartiles."""
    return Band(*np.mean([result["coverage"] for result in row.results], axis=0))


def _shares(row: Row) -> dict[str, torch.Tensor]:
    shares = {}
    for name in ("communication_share", "useful_share"):
        part, whole = (torch.from_numpy(counts).flatten() for counts in row.share(name))
        shares[name] = part / whole
    return shares


def _enlargements(row: Row) -> torch.Tensor:
    """One entry per enlargement, from the counts of each size."""
    counts = (torch.tensor(r["enlargements"], dtype=torch.int64) for r in row.results)
    return torch.cat([torch.arange(len(c)).repeat_interleave(c) for c in counts])


def _tradeoff(row: Row) -> tuple[torch.Tensor, torch.Tensor]:
    sent = np.mean([result["cells_sent"] for result in row.results], axis=0)
    return torch.from_numpy(sent), torch.from_numpy(_coverage(row).value)


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
