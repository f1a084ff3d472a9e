"""What the options of an update do to its speed: bfloat16, compiled networks.

python -m benchmarks.options [preset]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import torch

from benchmarks.timing import conditions, medians
from benchmarks.training import Iteration
from marl_explore.training.presets import PRESETS

OPTIONS: dict[str, dict[str, object]] = {
    "float32": {},
    "bfloat16": {"precision": "bfloat16"},
    "float32, compiled": {"compile": True},
    "bfloat16, compiled": {"precision": "bfloat16", "compile": True},
}


def measure(preset: str, repeats: int = 5, options: dict | None = None) -> dict[str, float]:
    """Median seconds of a whole iteration with each option."""
    contenders = {
        name: Iteration(replace(PRESETS[preset], **changes))
        for name, changes in (options or OPTIONS).items()
    }
    return medians(contenders, repeats)


def main() -> None:
    torch.set_num_threads(1)
    preset = sys.argv[1] if len(sys.argv) > 1 else "paper-mlp-case2"
    seconds = measure(preset)
    print(f"one iteration of {preset}, {conditions()}")
    for name, value in seconds.items():
        print(f"{name:>20}: {value:7.3f} s, {seconds['float32'] / value:5.2f} times as fast")


if __name__ == "__main__":
    main()
