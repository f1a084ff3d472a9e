"""What communication brings: steps to a complete map without it, with it, and against bytes sent.

python -m benchmarks.messages POLICY ... --tasks paper-12/4:200 open-24/4:100 --out messages

Policies are the goal actors among those that ``marl-explore evaluate`` takes, and the planners
``TIMED``. Task ``open-24/4:100`` is 100 test arenas of the suite with 4 robots. Each is played
without messages, with the radio of the task and with an unlimited one, and then with the radio of
the task and fewer and fewer messages. It writes ``messages.json``, ``.md`` and ``.png``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from tensordict import TensorDictBase
from torch import Tensor, nn

from benchmarks.completion import read_task
from marl_explore.arenas import default_steps
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.goals import GoalWeights
from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.evaluation import metrics
from marl_explore.evaluation.episodes import TEST_STREAM, Actor, record
from marl_explore.evaluation.plots.style import STYLE, legend, line_styles, save
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.stats import interval
from marl_explore.planners import FrontierAssignment, GoalUtility, NearestFrontier, PairTimer
from marl_explore.planners.assignment import UtilityCost
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.networks.goals import GoalActor

TIMED: dict[str, Callable[[ArenaConfig, int], Actor]] = {
    "goal-utility": lambda config, timer: GoalUtility(
        config.sight, GoalWeights(timer=timer), config
    ),
    "utility-cost": lambda config, timer: FrontierAssignment(
        PairTimer(timer), UtilityCost(), config
    ),
    "nearest-timer": lambda config, timer: NearestFrontier(PairTimer(timer), config),
}
"""Planners with another number of steps between the exchanges of two robots."""
TIMERS = (4, 8, 16, 32, 64)
NEVER, RADIO, UNLIMITED = "no messages", "the radio of the task", "unlimited radio"
_TIMER = [*asdict(GoalWeights())].index("timer")
_FOR_EVER = 10**9
CELL_BITS = 2
"""Of a cell that is unknown, free or occupied."""


@dataclass
class Scores:
    """What a policy did on every arena, [A] each."""

    to_95: np.ndarray
    """Steps until the largest map covers 95 %, one more than the longest episode if never."""
    to_100: np.ndarray
    whole: np.ndarray
    """Bytes per robot until then, if every message is a whole map."""
    delta: np.ndarray
    """The same, if messages hold what the sender has learned since its last one: each cell with its
    number, or the whole map where that is shorter."""


class Mute(nn.Module):
    """A policy whose robots never communicate; they stay instead."""

    def __init__(self, policy: Actor) -> None:
        super().__init__()
        self.policy, self.whole_batch = policy, getattr(policy, "whole_batch", False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act as if communicating were not allowed."""
        seen = tensordict.clone(recurse=False)
        mask = seen["agents", "action_mask"].clone()
        mask[..., COMMUNICATE] = False
        action = self.policy(seen.set(("agents", "action_mask"), mask))["agents", "action"]
        silent = action.masked_fill(action == COMMUNICATE, STAY)
        return tensordict.set(("agents", "action"), silent)


def with_timer(name: str, config: ArenaConfig, timer: int) -> Actor:
    """A policy that exchanges maps with each other robot at most every so many steps."""
    if name in TIMED:
        return TIMED[name](config, timer)
    policy = find_policy(name, config)
    team = policy.policy if isinstance(policy, ArgmaxPolicy) else policy
    for actor in team.actors:
        assert isinstance(actor, GoalActor), f"{name} has no timer"
        features = actor.encoder.features
        features.weights[_TIMER] = timer
        features.every, features.after = max(features.every, timer), max(features.after, timer)
    return policy


def play(
    policy: Actor, config: ArenaConfig, arenas: str, number: int, seed: int, stream: str
) -> Scores:
    """Run a policy on arenas of a suite."""
    steps = default_steps(arenas)
    episodes = record(policy, config, number, steps, seed, stream, arenas, until_mapped=True)
    scores = metrics.per_episode(episodes)
    to_95, to_100 = (scores[f"steps_to_{share}"].numpy() for share in (95, 100))
    running = metrics.before_completion(episodes)
    whole = metrics.bytes_sent(episodes, running) / config.num_agents
    delta = delta_bytes(episodes, running) / config.num_agents
    return Scores(to_95, to_100, whole.double().numpy(), delta.double().numpy())


def delta_bytes(episodes: metrics.Episodes, steps: Tensor) -> Tensor:
    """Bytes of all messages that hold what is new since the sender's last one, int64 [B].

    Args:
        episodes: B episodes.
        steps: bool [B, T], the steps to count.
    """
    bits = CELL_BITS + math.ceil(math.log2(episodes.num_cells))
    most = -(-episodes.num_cells // metrics.CELLS_PER_BYTE)
    talks = (episodes.action == COMMUNICATE) & episodes.acting & steps.unsqueeze(-1)
    known, sent = episodes.maps.known_cells, 0
    told = torch.zeros_like(known[:, 0])
    for step in range(episodes.horizon):
        new = known[:, step] - told
        told = torch.where(talks[:, step], known[:, step], told)
        sent = sent + ((new * bits + 7) // 8).clamp_max(most) * talks[:, step]
    return sent.sum(-1)


def measure(
    names: Sequence[str], task: str, seed: int = 0, stream: str = TEST_STREAM
) -> dict[str, dict[str, Scores]]:
    """Scores by policy and by how much robots communicate."""
    arenas, config, number = read_task(task)
    free = replace(config, communication_range=math.inf, wall_loss_db=0.0)
    results: dict[str, dict[str, Scores]] = {}
    for name in names:
        cases: dict[str, tuple[Actor, ArenaConfig]] = {
            NEVER: (Mute(with_timer(name, config, _FOR_EVER)), config),
            RADIO: (find_policy(name, config), config),
            UNLIMITED: (find_policy(name, free), free),
        }
        cases |= {f"every {n} steps": (with_timer(name, config, n), config) for n in TIMERS}
        for case, (policy, world) in cases.items():
            scores = play(policy, world, arenas, number, seed, stream)
            results.setdefault(name, {})[case] = scores
            print(
                f"{task} {name}, {case}: {scores.to_100.mean():.1f} steps, "
                f"{scores.whole.mean():.0f} / {scores.delta.mean():.0f} bytes per robot",
                flush=True,
            )
    return results


def table(results: dict[str, dict[str, dict[str, Scores]]]) -> str:
    """Steps and bytes in Markdown, a row for each task, policy and amount of communication."""
    lines = [
        "| task | policy | robots send | steps to 95 % | steps to 100 % | bytes per robot, whole "
        "maps | bytes per robot, new cells |",
        "|---|---|---|---|---|---|---|",
    ]
    for task, of_policies in results.items():
        for name, cases in of_policies.items():
            for case, scores in cases.items():
                value, low, high = interval(scores.to_100, np.mean)
                cells = (
                    *(task, name, case, f"{scores.to_95.mean():.1f}"),
                    f"{value:.1f} [{low:.1f}, {high:.1f}]",
                    *(f"{sent.mean():.0f}" for sent in (scores.whole, scores.delta)),
                )
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def figure(results: dict[str, dict[str, dict[str, Scores]]], path: Path) -> None:
    """Steps to 100 % against bytes per robot: whole maps (solid) and new cells (dotted).

    Thin lines are those of teams that send no messages.
    """
    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(4 * len(results) + 2, 3.8), layout="constrained")
        panels = drawn.subplots(1, len(results), squeeze=False)[0]
        for axes, (task, of_policies) in zip(panels, results.items(), strict=True):
            for name, style in line_styles(of_policies):
                cases = of_policies[name]
                timed = [cases[f"every {timer} steps"] for timer in TIMERS]
                for kind, dashes in (("whole", "-"), ("delta", ":")):
                    shown = style | {"linestyle": dashes, "marker": "o", "markersize": 3}
                    shown["label"] = f"{name}, {'whole maps' if kind == 'whole' else 'new cells'}"
                    sent = [getattr(one, kind).mean() for one in timed]
                    axes.plot(sent, [one.to_100.mean() for one in timed], **shown)
                silent = cases[NEVER].to_100.mean()
                axes.axhline(silent, color=style["color"], linewidth=0.8, alpha=0.5)
            axes.set(title=task, xlabel="bytes per robot", ylabel="steps to 100 %", xscale="log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.grid(alpha=0.25)
        legend(drawn, panels[0])
        save(drawn, path)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--tasks", nargs="+", default=["paper-12/4:200", "open-24/4:100"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stream", default=TEST_STREAM)
    parser.add_argument("--out", type=Path, default=Path("messages"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    results = {
        task: measure(words.policies, task, words.seed, words.stream) for task in words.tasks
    }
    kept = {
        task: {
            name: {
                case: {kind: np.round(x, 1).tolist() for kind, x in vars(scores).items()}
                for case, scores in cases.items()
            }
            for name, cases in of_policies.items()
        }
        for task, of_policies in results.items()
    }
    words.out.with_suffix(".json").write_text(json.dumps(kept))
    words.out.with_suffix(".md").write_text(table(results))
    figure(results, words.out.with_suffix(".png"))
    print(table(results))


if __name__ == "__main__":
    main()
