"""Execution settings of a run: collection, validation, checkpoints, logging."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from marl_explore.config.checks import (
    MAX_INTEGER,
    require,
    require_integer,
    require_threads,
)
from marl_explore.config.fields import check_types

CollectorKind = Literal["process", "multisync", "multiasync", "ray"]
LoggerName = Literal["csv", "tensorboard", "wandb", "mlflow"]
Selection = Literal["steps_to_80", "steps_to_90", "steps_to_95", "steps_to_99", "steps_to_100"]
MAX_SEEDS = 10_000
"""Most runs of one sweep."""


@dataclass(frozen=True)
class RunConfig:
    """Execution settings of a run; ``TrainConfig`` has what is learned.

    ``collector``, ``workers``, ``threads`` and ``device`` affect what is learned: every worker and
    device samples actions from a random generator of its own, and sums are in another order.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    collector: CollectorKind = "process"
    """Who collects data: this process, worker processes (in step or not), or Ray's workers."""
    workers: int = 1
    """Number of workers, which share the arenas evenly."""
    ray_address: str | None = None
    """Ray cluster to join, "auto" or host:port; None: start Ray on this machine."""
    threads: int = 1
    """CPU threads of torch."""
    device: str = "cpu"
    """Where the run computes: cpu, or cuda, cuda:1, ... with collector "process" (not tested)."""
    checkpoint_every: int = 20
    """Updates between checkpoints; 0: only at the end."""
    keep_checkpoints: int = 3
    """Number of newest checkpoints that are kept."""
    validate_every: int = 50
    """Updates between validations of the policy; 0: never."""
    validation_arenas: int = 64
    """Arenas of a validation, always the same, and different from training and test arenas."""
    validation_steps: int | None = None
    """Length of a validation episode in steps; None: as in an evaluation on the run's arenas."""
    select_by: Selection = "steps_to_100"
    """Validation measure whose smallest value selects the best policy."""
    logger: LoggerName = "csv"
    """Logger of the metrics, in addition to CSV files, which are always written."""

    def __post_init__(self) -> None:
        """Raise an error for settings that are not allowed."""
        check_types(self)
        for name in ("workers", "keep_checkpoints", "validation_arenas"):
            require_integer(name, getattr(self, name), 1)
        require_threads(self.threads)
        if self.validation_steps is not None:
            require_integer("validation_steps", self.validation_steps, 1)
        for name in ("checkpoint_every", "validate_every"):
            require_integer(name, getattr(self, name), 0)
        if self.collector == "process" and self.workers > 1:
            raise ValueError(
                f"workers={self.workers} is not allowed with collector='process': use multisync, "
                "multiasync or ray"
            )
        if self.collector != "process" and self.device != "cpu":
            raise ValueError(
                f"device={self.device!r} is not allowed with collector={self.collector!r}, whose "
                "workers compute on the CPU: use collector='process'"
            )
        if self.ray_address is not None and self.collector != "ray":
            raise ValueError(
                f"ray_address={self.ray_address!r} needs collector='ray', "
                f"got collector={self.collector!r}"
            )


def parse_seeds(text: str) -> list[int]:
    """Seeds from text with ranges and numbers, such as "0-4" or "0,2,7-9".

    Raises:
        ValueError: for anything else, and for a seed that is given twice.
    """
    seeds: list[int] = []
    for part in text.split(","):
        bounds = part.split("-")
        numbers = [int(b) for b in bounds if b.isdecimal() and len(b) < 20]
        if len(numbers) < len(bounds) or len(bounds) > 2 or numbers[0] > numbers[-1]:
            raise ValueError(
                f"seeds={text!r} is not allowed: use a range 0-4 or a list 0,2,7 of integers up to "
                f"{MAX_INTEGER}"
            )
        require(
            numbers[-1] <= MAX_INTEGER and numbers[-1] - numbers[0] + len(seeds) < MAX_SEEDS,
            "seeds",
            text,
            f"use at most {MAX_SEEDS} seeds, up to {MAX_INTEGER}",
        )
        seeds += range(numbers[0], numbers[-1] + 1)
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds={text!r} is not allowed: give every seed only once")
    return seeds
