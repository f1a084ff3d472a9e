"""Progress of runs: one bar for a run, or one for each run of a sweep."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from tqdm import tqdm

Report = Callable[[int, int, Mapping[str, str]], None]
"""Is told the steps done, the steps of the whole run, and numbers to show, after every update."""

HEADLINE = {
    "return": ("episode_return", "{:.1f}"),
    "coverage": ("final_coverage", "{:.1%}"),
    "communicate": ("communication_share", "{:.0%}"),
}
"""Numbers in a progress bar: title, metric and format."""


class Progress:
    """Tells a ``Report`` about a run, or shows a bar.

    Args:
        show: whether to show a bar, or what to report to.
        done: steps done before.
        total: steps of the whole run.
    """

    def __init__(self, show: bool | Report, done: int, total: int) -> None:
        self._done, self._total = done, total
        self._headline: dict[str, str] = {}
        self._bar: tqdm[Any] | None = None
        if isinstance(show, bool):
            self._bar = progress_bar(done, total, disable=not show)
            show = self._draw
        self._report = show

    def update(self, metrics: Mapping[str, float], steps: int) -> None:
        """Take the metrics of an update and its number of steps."""
        self._done += steps
        self._headline |= {
            title: form.format(metrics[key])
            for title, (key, form) in HEADLINE.items()
            if key in metrics
        }
        self._report(self._done, self._total, self._headline)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def _draw(self, done: int, total: int, headline: Mapping[str, str]) -> None:
        assert self._bar is not None
        draw(self._bar, done, headline)


def progress_bar(done: int, total: int, **options: Any) -> tqdm[Any]:
    """A bar of steps, which writes few lines to a log file."""
    every = 0.2 if sys.stderr.isatty() else 15
    return tqdm(total=total, initial=done, unit=" steps", mininterval=every, **options)


def draw(bar: tqdm[Any], done: int, headline: Mapping[str, str]) -> None:
    """Move a bar to a number of steps."""
    bar.set_postfix(headline, refresh=False)
    bar.update(done - bar.n)


class Bars:
    """A bar for each run of a sweep, fed by the processes that run them."""

    def __init__(self) -> None:
        self._bars: dict[int, tqdm[Any]] = {}

    def draw(self, seed: int, reports: Connection) -> None:
        """Show the latest report of a run."""
        latest = None
        with suppress(EOFError, OSError):  # it has ended
            while reports.poll():
                latest = reports.recv()
        if latest is None:
            return
        done, total, headline = latest
        if seed not in self._bars:
            used = {-bar.pos for bar in self._bars.values()}
            slot = next(n for n in range(len(used) + 1) if n not in used)
            self._bars[seed] = progress_bar(done, total, desc=f"seed {seed}", position=slot)
        draw(self._bars[seed], done, headline)

    def end(self, seed: int, outcome: str) -> None:
        """Replace the bar of a run by a line with its outcome."""
        if seed in self._bars:
            self._bars.pop(seed).close()
        tqdm.write(f"seed {seed}: {outcome}", file=sys.stdout)

    def close(self) -> None:
        """Leave the bars as they are."""
        for bar in self._bars.values():
            bar.close()


def reporter(reports: Connection) -> Report:
    """A ``Report`` that sends what it is told, until nobody listens."""

    def report(*told: object) -> None:
        with suppress(OSError):
            reports.send(told)

    return report
