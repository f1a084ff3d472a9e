"""Steps to a complete map against everything that can go wrong, with intervals.

python -m benchmarks.robustness POLICY OTHER ... --num-arenas 100 --out robustness

Policies are names that ``marl-explore evaluate`` takes. The base is a team of four with lidars on
24 x 24 cells of six kinds in turn; each fault changes one setting of it, on the same arenas. It
writes ``robustness.json``, ``robustness.md`` with the price of each fault and ``robustness.png``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation.episodes import TEST_STREAM, Actor, record
from marl_explore.evaluation.metrics import per_episode
from marl_explore.evaluation.plots.style import STYLE, legend, line_styles, save
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.stats import interval, paired_difference

BASE = ArenaConfig(
    height=24,
    width=24,
    sensing_range=3.5,
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=4.0,
)
ARENAS, STEPS = "mixed", 300
ASSUMED = "assumed / true sensor range"


@dataclass(frozen=True)
class Fault:
    """One thing that can go wrong, from not at all to badly."""

    name: str
    setting: str
    """Field of ``ArenaConfig``; "" for what robots assume about their own sensors."""
    levels: tuple[float, ...]
    """The first is that of ``BASE``."""


FAULTS = (
    Fault("share of messages lost", "message_loss", (0.0, 0.1, 0.2, 0.3, 0.5)),
    Fault("failures of a robot per step", "failure_rate", (0.0, 0.0005, 0.001, 0.002, 0.005)),
    Fault("loss of a wall (dB)", "wall_loss_db", (0.0, 3.0, 6.0, 12.0, math.inf)),
    Fault("people who walk about", "num_walkers", (0, 2, 4, 8)),
    Fault("steps per move", "move_period", (1, 2, 3)),
    Fault(ASSUMED, "", (1.0, 0.5, 0.75, 1.5, 2.0)),
)


@dataclass
class Scores:
    """What a policy did at one level of a fault."""

    to_95: np.ndarray
    """Steps until the largest map covers 95 %, one more than the longest episode if never, [A]."""
    to_100: np.ndarray
    finished: float
    """Of the arenas that could be finished, those that were."""


class Assuming(nn.Module):
    """A policy that takes its robots' sensors for others.

    Args:
        name: of the policy.
        config: the robots as they are.
        factor: assumed range / true range.
    """

    def __init__(self, name: str, config: ArenaConfig, factor: float) -> None:
        super().__init__()
        assert isinstance(config.sensing_range, float)
        assumed = replace(config, sensing_range=factor * config.sensing_range)
        self.policy, self.radius = find_policy(name, assumed), assumed.fov_radius
        self.whole_batch = getattr(self.policy, "whole_batch", False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act on the middle of the field of view, or on one with a margin that is never seen."""
        seen = tensordict.clone(recurse=False)
        fov: Tensor = seen["agents", "observation", "fov"]
        margin = self.radius - fov.shape[-1] // 2
        wider = torch.nn.functional.pad(fov, [margin] * 4, value=1.0)  # negative: cut off
        return self.policy(seen.set(("agents", "observation", "fov"), wider))


def play(
    name: str, fault: Fault, level: float, num_arenas: int, seed: int, stream: str = TEST_STREAM
) -> Scores:
    """Run a policy at one level of a fault."""
    config = replace(BASE, **{fault.setting: level}) if fault.setting else BASE
    policy: Actor = find_policy(name, config)
    if not fault.setting and level != 1:
        policy = Assuming(name, config, level)
    episodes = record(policy, config, num_arenas, STEPS, seed, stream, ARENAS, until_mapped=True)
    scores = per_episode(episodes)
    to_95, to_100 = (scores[f"steps_to_{share}"].numpy() for share in (95, 100))
    done = torch.from_numpy(to_100 <= STEPS)
    possible = done | episodes.finishable
    return Scores(to_95, to_100, float(done.sum() / possible.sum()))


def measure(
    names: Sequence[str],
    num_arenas: int,
    seed: int = 0,
    stream: str = TEST_STREAM,
    faults: Sequence[Fault] = FAULTS,
) -> dict[str, dict[str, list[Scores]]]:
    """Scores by policy and fault, one for every level."""
    results: dict[str, dict[str, list[Scores]]] = {}
    for name in names:
        base = play(name, faults[0], faults[0].levels[0], num_arenas, seed, stream)
        for fault in faults:
            rest = [play(name, fault, x, num_arenas, seed, stream) for x in fault.levels[1:]]
            results.setdefault(name, {})[fault.name] = [base, *rest]
            steps = ", ".join(f"{one.to_100.mean():.1f}" for one in (base, *rest))
            print(f"{name}: {fault.name}: {steps}", flush=True)
    return results


def table(results: dict[str, dict[str, list[Scores]]], faults: Sequence[Fault] = FAULTS) -> str:
    """The price of each fault in Markdown: steps to 100 %, and in brackets what it adds."""
    names = [*results]
    lines = ["| fault | level |" + "".join(f" {name} |" for name in names)]
    lines.append("|---|---|" + "---|" * len(names))
    base = [results[name][faults[0].name][0] for name in names]
    lines.append("| none | |" + "".join(f" {_steps(one)} |" for one in base))
    for fault in faults:
        for number, level in enumerate(fault.levels[1:], 1):
            cells = (_price(results[name][fault.name], number) for name in names)
            lines.append(f"| {fault.name} | {level:g} |" + "".join(f" {x} |" for x in cells))
    return "\n".join(lines) + "\n"


def _steps(scores: Scores) -> str:
    value, low, high = interval(scores.to_100, np.mean)
    return f"{value:.1f} [{low:.1f}, {high:.1f}]{_unfinished(scores)}"


def _price(levels: Sequence[Scores], number: int) -> str:
    scores = levels[number]
    value, low, high = paired_difference(scores.to_100, levels[0].to_100)
    mean = scores.to_100.mean()
    return f"{mean:.1f} ({value:+.1f} [{low:+.1f}, {high:+.1f}]){_unfinished(scores)}"


def _unfinished(scores: Scores) -> str:
    return "" if scores.finished == 1 else f", {100 * scores.finished:.0f} % finished"


def figure(
    results: dict[str, dict[str, list[Scores]]], path: Path, faults: Sequence[Fault] = FAULTS
) -> None:
    """Steps to 95 % (below) and 100 % (above) against the level of every fault."""
    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(2.4 * len(faults) + 1.5, 5), layout="constrained")
        axes = drawn.subplots(2, len(faults), sharey=False, squeeze=False)
        for column, fault in enumerate(faults):
            order = np.argsort(fault.levels)
            ticks = [f"{fault.levels[i]:g}" for i in order]
            for row, measured in enumerate(("to_100", "to_95")):
                for number, (name, style) in enumerate(line_styles(results)):
                    beside = 0.08 * (number - (len(results) - 1) / 2)  # bars do not hide others
                    places = np.arange(len(order)) + beside
                    scores = [getattr(results[name][fault.name][i], measured) for i in order]
                    found = np.array([interval(one, np.mean) for one in scores]).T
                    bars = np.abs(found[1:] - found[0])
                    axes[row, column].errorbar(places, found[0], bars, capsize=2, **style)
                axes[row, column].set_xticks(range(len(order)), ticks)
                axes[row, 0].set_ylabel(f"steps to {measured.removeprefix('to_')} %")
            axes[0, column].set_title(fault.name, fontsize="medium")
        legend(drawn, axes[0, 0])
        save(drawn, path)


def to_json(results: dict[str, dict[str, list[Scores]]]) -> dict[str, Any]:
    """Steps on every arena, by policy, fault and level."""
    levels = {fault.name: [f"{level:g}" for level in fault.levels] for fault in FAULTS}
    scores = {
        name: {
            fault: [
                {
                    "to_95": one.to_95.astype(int).tolist(),
                    "to_100": one.to_100.astype(int).tolist(),
                    "finished": one.finished,
                }
                for one in of_levels
            ]
            for fault, of_levels in of_faults.items()
        }
        for name, of_faults in results.items()
    }
    return {"levels": levels, "steps": STEPS, "scores": scores}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--num-arenas", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stream", default=TEST_STREAM)
    parser.add_argument("--out", type=Path, default=Path("robustness"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    results = measure(words.policies, words.num_arenas, words.seed, words.stream)
    words.out.with_suffix(".json").write_text(json.dumps(to_json(results)))
    words.out.with_suffix(".md").write_text(table(results))
    figure(results, words.out.with_suffix(".png"))
    print(table(results))


if __name__ == "__main__":
    main()
