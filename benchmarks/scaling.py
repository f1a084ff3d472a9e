"""Training steps per second over the number of workers, and where more of them stop paying.

python -m benchmarks.scaling
python -m benchmarks.scaling --preset fast --num-envs 512 --workers 1 2 4 --collector ray
python -m benchmarks.scaling --arenas lidar-32 --num-envs 1024 --rollout-steps 10

Seconds per update with W workers: U + F + C / W + a + b W. U is the update in the main process; a
batch in one process takes F + C, of which F is there for any number of arenas (calls of Python and
torch, once per step); a is the cost of asking for a batch, and b what a worker costs the main
process: parameters out, data and state in.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from dataclasses import dataclass, replace

import torch

from marl_explore import parse_options
from marl_explore.arenas import fit
from marl_explore.config.run import CollectorKind, RunConfig
from marl_explore.training.config import TrainConfig
from marl_explore.training.presets import PRESETS
from marl_explore.training.trainer import Trainer


@dataclass(frozen=True)
class Model:
    """Seconds per update as a function of workers."""

    update: float
    fixed: float
    divisible: float
    ask: float
    per_worker: float

    @classmethod
    def fit(cls, update: float, alone: float, half: float, collections: dict[int, float]) -> Model:
        """From a batch in one process, one of half of the arenas, and those of workers.

        What workers take beyond F + C / W is a + b W, by least squares.
        """
        divisible = 2 * (alone - half)
        fixed = alone - divisible
        extra = [seconds - fixed - divisible / w for w, seconds in collections.items()]
        slope, ask = statistics.linear_regression([*collections], extra)
        return cls(update, fixed, divisible, ask, slope)

    def seconds(self, workers: int) -> float:
        """Of one update."""
        whole = self.update + self.fixed + self.ask
        return whole + self.divisible / workers + self.per_worker * workers

    @property
    def best_workers(self) -> int:
        """Where one more worker costs as much as it brings, sqrt(C / b); 0: nowhere."""
        measured = self.per_worker > 0 and self.divisible > 0  # else noise was larger than they are
        return round(math.sqrt(self.divisible / self.per_worker)) if measured else 0

    def __str__(self) -> str:
        best = self.best_workers
        most = self.seconds(1) / (self.seconds(best) if best else self.update + self.fixed)
        return (
            f"U = {self.update:.3f} s, F = {self.fixed:.3f} s, C = {self.divisible:.3f} s, "
            f"a = {self.ask:.4f} s, b = {self.per_worker:.4f} s: best at {best or 'any'} workers, "
            f"{most:.2f} x one worker"
        )


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    preset: str = "fast"
    num_envs: int | None = None
    """Arenas; default: the preset's."""
    arenas: str = "uniform"
    """Kind of arenas, or a suite with its robots."""
    rollout_steps: int | None = None
    """Steps of a batch; default: the preset's."""
    collector: CollectorKind = "multisync"
    workers: tuple[int, ...] = (1, 2)
    repeats: int = 7
    """Batches and updates per number of workers; the median counts."""

    @property
    def config(self) -> TrainConfig:
        """The training that is measured."""
        preset = PRESETS[self.preset]
        return replace(
            preset,
            scenes=(),
            arenas=self.arenas,
            arena=fit(preset.arena, self.arenas),
            num_envs=self.num_envs or preset.num_envs,
            rollout_steps=self.rollout_steps or preset.rollout_steps,
        )


def measure(config: TrainConfig, run: RunConfig, repeats: int) -> tuple[float, float]:
    """Median seconds of a batch and of an update."""
    trainer = Trainer(config, run)
    collections, updates = [], []
    trainer.collect()  # starts the workers
    for _ in range(repeats):
        start = time.perf_counter()
        (batch,) = trainer.collect()
        collected = time.perf_counter()
        trainer.update(batch)
        collections.append(collected - start)
        updates.append(time.perf_counter() - collected)
    trainer.rollouts.close()
    return statistics.median(collections), statistics.median(updates)


def main(arguments: Arguments) -> list[str]:
    """A row per number of workers, and the model's constants."""
    config, repeats, kind = arguments.config, arguments.repeats, arguments.collector
    alone, update = measure(config, RunConfig(), repeats)
    half, _ = measure(replace(config, num_envs=config.num_envs // 2), RunConfig(), repeats)
    there = {
        w: measure(config, RunConfig(collector=kind, workers=w), repeats)[0]
        for w in arguments.workers
    }
    lines = [f"{'':>10}  {'batch s':>8}  {'update s':>8}  {'steps/s':>8}  batch x  whole x"]
    for name, seconds in {"in process": alone, **there}.items():
        whole = seconds + update
        lines.append(
            f"{name:>10}  {seconds:8.3f}  {update:8.3f}  "
            f"{config.batch_frames / whole:8.0f}  {alone / seconds:7.2f}  "
            f"{(alone + update) / whole:7.2f}"
        )
    if len(there) > 1:
        lines.append(str(Model.fit(update, alone, half, there)))
    return lines


if __name__ == "__main__":
    torch.set_num_threads(1)
    asked = parse_options(Arguments, sys.argv[1:], "benchmarks.scaling", __doc__)
    print(f"{asked}, torch {torch.__version__}")
    print("\n".join(main(asked)))
