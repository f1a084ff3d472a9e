"""Sweeps: one training run per seed, side by side, and a summary over seeds."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from marl_explore.config.checks import require, require_integer
from marl_explore.config.fields import check_types, read_fields
from marl_explore.config.run import MAX_SEEDS, RunConfig
from marl_explore.evaluation.stats import seed_mean
from marl_explore.training import runs
from marl_explore.training.config import TrainConfig
from marl_explore.training.progress import Bars, reporter
from marl_explore.training.run_folder import (
    is_finished,
    longer,
    prepare,
    read_record,
    write_longer,
)
from marl_explore.utils import records, tables
from marl_explore.utils.curves import read_curve
from marl_explore.utils.interrupts import (
    RunInterruptedError,
    deferred,
    detach,
    end_with_parent,
)
from marl_explore.utils.json_files import read_json
from marl_explore.utils.locks import owned

RECORD_FILE, SUMMARY_FILE = "sweep.json", "summary.json"
LAST_SHARE = 0.1
MAIN_METRICS = (
    "validation_steps_to_95",
    "validation_steps_to_100",
    "validation_complete",
    "episode_return",
    "final_coverage",
    "communication_share",
)
"""Metrics in the printed table; the file holds every metric."""

Summary = dict[str, dict[str, float | None]]

PATIENCE = 120.0
"""How long a run waits for the process of a killed sweep, which ends after its update (seconds)."""


@dataclass(frozen=True)
class SweepRecord:
    """How a sweep was made: the content of ``sweep.json``."""

    seeds: tuple[int, ...]
    jobs: int | None = None
    """Runs side by side; None: as many as the cores allow."""
    starts: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        """Raise an error for fields that are not allowed."""
        check_types(self)
        for seed in self.seeds:
            require_integer("seeds", seed, 0)
        allowed = f"use 1 to {MAX_SEEDS} seeds, each only once"
        unique = len(set(self.seeds)) == len(self.seeds)
        require(unique and 0 < len(self.seeds) <= MAX_SEEDS, "seeds", self.seeds, allowed)
        if self.jobs is not None:
            require_integer("jobs", self.jobs, 1)

    def write(self, folder: Path) -> None:
        """Write the file of a sweep's folder."""
        records.write_json(folder / RECORD_FILE, asdict(self))


def sweep(
    config: TrainConfig,
    folder: str | Path,
    seeds: Sequence[int],
    run: RunConfig | None = None,
    jobs: int | None = None,
) -> Summary:
    """Train once per seed, in run folders ``seed-0``, ... of a new folder.

    Args:
        config: of every run, except the seed.
        folder: must not exist, or be empty.
        seeds: of the runs.
        run: execution settings of every run.
        jobs: runs side by side; default: as many as the cores allow.

    Returns:
        ``summarize_seeds``; also written to ``summary.json``.

    Raises:
        ValueError: before anything is written, when seeds are missing or given twice, ``jobs`` is
            less than 1, a setting is wrong, or the folder is in use.
        RunInterruptedError: after a SIGINT or SIGTERM, once every run has saved a checkpoint.
        ChildProcessError: when a run failed; it names the seeds and their logs.
    """
    run = run or RunConfig()
    record = SweepRecord(tuple(seeds), jobs)
    runs.make_trainer(config, run)  # rejects wrong settings before a folder is made
    folder = records.new_folder(folder)
    for seed in seeds:
        prepare(replace(config, seed=seed), folder / _name(seed), run)
    # written last: a folder with this file can be resumed
    record.write(folder)
    return resume_sweep(folder)


def is_sweep(folder: str | Path) -> bool:
    """Whether a folder was made by ``sweep``."""
    return (Path(folder) / RECORD_FILE).is_file()


def seed_runs(*paths_or_names: str | Path) -> list[str]:
    """The run folders of finished sweeps, one per seed; other paths and names unchanged.

    Raises:
        ValueError: naming the seeds of a sweep that are not finished.
    """
    return [run for path in paths_or_names for run in _seed_runs(path)]


def _seed_runs(path_or_name: str | Path) -> list[str]:
    if not is_sweep(path_or_name):
        return [str(path_or_name)]
    folder = Path(path_or_name)
    seeds = read_sweep(folder).seeds
    waiting = _unfinished(folder, seeds)
    if waiting:
        raise ValueError(
            f"seeds {waiting} of the sweep in {folder} are not finished: {_how(folder)}"
        )
    return [str(folder / _name(seed)) for seed in seeds]


def read_sweep(folder: Path) -> SweepRecord:
    """The record of a sweep.

    Raises:
        ValueError: naming file and field, when a field is wrong.
    """
    path = folder / RECORD_FILE
    return read_fields(SweepRecord, read_json(path), str(path))


def resume_sweep(folder: str | Path, episodes: int | None = None) -> Summary:
    """Resume every unfinished run of a sweep; otherwise as ``sweep``.

    Args:
        folder: of the sweep.
        episodes: new length of every run, as for ``lengthen``.

    Raises:
        ValueError: also when another process owns the sweep.
    """
    folder = Path(folder)
    record = read_sweep(folder)
    with owned(folder):
        if episodes is not None:
            runs_of_it = [folder / _name(seed) for seed in record.seeds]
            for run in runs_of_it:
                longer(run, episodes)  # refused before any is changed
            for run in runs_of_it:
                with owned(run, PATIENCE):
                    write_longer(run, episodes)
        return _resume(folder, record)


def _resume(folder: Path, record: SweepRecord) -> Summary:
    replace(record, starts=(*record.starts, records.provenance())).write(folder)
    seeds = record.seeds
    waiting = _unfinished(folder, seeds)
    run = read_record(folder / _name(seeds[0])).execution
    failed = _run_all(folder, waiting, record.jobs or _jobs(run))
    if failed:
        logs = ", ".join(str(folder / f"{_name(seed)}.log") for seed in failed)
        raise ChildProcessError(f"seeds {failed} failed, see {logs}; {_how(folder)}")
    summary = summarize_seeds(folder, seeds)
    records.write_json(folder / SUMMARY_FILE, summary)
    return summary


def summarize_seeds(folder: Path, seeds: Sequence[int]) -> Summary:
    """For every metric, the mean over seeds with its bootstrap interval (``stats.seed_mean``).

    The value of a run is the mean over the last tenth of its updates that have the metric. Bounds
    are None where only one seed has it.
    """
    values: dict[str, list[float]] = {}
    for seed in seeds:
        for file in sorted((folder / _name(seed) / "scalars").glob("*.csv")):
            values_read = read_curve(file)[:, 1]
            rows = values_read[np.isfinite(values_read)]  # NaN: nothing was measured
            if len(rows):
                last = rows[-max(1, round(LAST_SHARE * len(rows))) :]
                values.setdefault(file.stem, []).append(float(np.mean(last)))
    summary: Summary = {}
    for name, of_seeds in values.items():
        mean, *bounds = seed_mean(of_seeds)
        low, high = (None if math.isnan(bound) else bound for bound in bounds)
        summary[name] = {"mean": mean, "low": low, "high": high, "seeds": len(of_seeds)}
    return summary


def format_summary(summary: Mapping[str, Mapping[str, float | None]]) -> str:
    """A text table of the main metrics."""
    rows = []
    for name in MAIN_METRICS:
        if name in summary:
            values = (summary[name][key] for key in ("mean", "low", "high"))
            rows.append([name, *("-" if value is None else f"{value:.3f}" for value in values)])
    return tables.text(["over seeds", "mean", "low", "high"], rows)


def _run_all(folder: Path, seeds: Sequence[int], jobs: int) -> list[int]:
    """Run the seeds side by side; returns those that failed."""
    waiting, failed = list(seeds), []
    running: dict[int, tuple[BaseProcess, Connection]] = {}
    with deferred() as request, closing(Bars()) as bars:
        while running or waiting:
            while waiting and len(running) < jobs:
                seed = waiting.pop(0)
                running[seed] = _start(folder / _name(seed))
            wait([process.sentinel for process, _ in running.values()], timeout=0.2)
            if request.signal is not None:
                _stop([process for process, _ in running.values()])
                raise RunInterruptedError(request.signal, _how(folder))
            for seed, (process, reports) in [*running.items()]:
                bars.draw(seed, reports)
                if process.exitcode is not None:
                    del running[seed]
                    bars.end(seed, "failed" if process.exitcode else "done")
                    failed += [seed] if process.exitcode else []
    return sorted(failed)


def _start(folder: Path) -> tuple[BaseProcess, Connection]:
    """A process that resumes a run, and the pipe through which it reports."""
    reader, writer = Pipe(duplex=False)
    process = get_context("spawn").Process(target=_run_one, args=(folder, writer))
    process.start()
    writer.close()
    return process, reader


def _stop(processes: Iterable[BaseProcess]) -> None:
    """Let runs finish their update and save a checkpoint."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.join()


def _run_one(folder: Path, reports: Connection) -> None:
    """One run in a process of its own; its output goes to a log next to its folder."""
    detach()
    end_with_parent()
    with (
        folder.with_name(f"{folder.name}.log").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        try:
            runs.resume(folder, progress=reporter(reports), patience=PATIENCE)
        except RunInterruptedError as interrupted:
            print(interrupted)
            sys.exit(interrupted.status)
        except (ValueError, OSError, FloatingPointError) as error:
            print(f"error: {error}")
            sys.exit(1)
        except Exception:
            traceback.print_exc()
            sys.exit(1)


def _unfinished(folder: Path, seeds: Sequence[int]) -> list[int]:
    return [seed for seed in seeds if not is_finished(folder / _name(seed))]


def _how(folder: Path) -> str:
    return f"resume it with: marl-explore resume {folder}"


def _name(seed: int) -> str:
    return f"seed-{seed}"


def _jobs(run: RunConfig) -> int:
    """How many runs the cores allow."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (cores or 1) // (run.threads * run.workers))
