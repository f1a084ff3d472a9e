"""Policies that come with the package: how a run becomes one, and the scores they replay to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from marl_explore import metrics
from marl_explore.evaluation import record
from marl_explore.policies import BUNDLED, Policy, load_policy, policy_info, save_policy
from marl_explore.runs import CONFIG_FILE, RECORD_FILE, read_settings

REPLAY_ARENAS = 20
"""Test arenas that a bundled policy replays to its recorded score."""
SCORE_ARENAS = 200
STEPS = 300
CURVES = ("episode_return", "final_coverage", "communication_share", "entropy")
_POINTS = 50


def replay_score(
    policy: Policy, num_arenas: int = REPLAY_ARENAS, arenas: str = "uniform"
) -> dict[str, list[int]]:
    """What a policy does on the first test arenas of a kind, to the cell and the step.

    Networks compute in float64, so that the order in which a processor adds up decides nothing.

    Args:
        policy: as ``load_policy`` gives it; it is changed to float64.
        num_arenas: B.
        arenas: their kind, such as a suite's name.

    Returns:
        Per arena, steps until the largest map is complete, its known target cells at the end, and
        the cells sent by all robots.
    """
    episodes = record(policy.double(), policy.spec.arena, num_arenas, STEPS, arenas=arenas)
    known = episodes.maps.known_targets.amax(-1)
    return {
        "steps_to_100": metrics.steps_to(known, episodes.num_targets, 1.0).tolist(),
        "known_targets": known[:, -1].tolist(),
        "cells_sent": metrics.cells_sent(episodes)[:, -1].tolist(),
    }


def run_info(run: str | Path) -> dict[str, Any]:
    """What there is to tell of a finished run: configuration, record and curves.

    Raises:
        ValueError: when the folder is no run, or the run is not finished.
    """
    run = Path(run)
    read_settings(run)  # refuses what is no run
    how = json.loads((run / RECORD_FILE).read_text())
    if not how.get("finished"):
        raise ValueError(f"the run in {run} is not finished: go on with it first")
    return {
        "config": json.loads((run / CONFIG_FILE).read_text()),
        "run": how,
        "curves": {curve: _curve(run / "scalars" / f"{curve}.csv") for curve in CURVES},
    }


def score(policy: Policy, arenas: str = "uniform") -> dict[str, float]:
    """Every measure of a policy on 200 test arenas of a kind."""
    return metrics.summarize(record(policy, policy.spec.arena, SCORE_ARENAS, STEPS, arenas=arenas))


def bundle(run: str | Path, name: str, folder: str | Path = BUNDLED) -> Path:
    """Make the policy of a finished run one that comes with the package, weights in float16.

    Its file also holds the ``run_info``, and the ``score`` and the ``replay_score`` of the weights
    as they are shipped, on arenas of the kind the run was trained on.

    Args:
        run: folder of a finished run.
        name: what ``load_policy`` will know it by.
        folder: where it is written; made when it does not exist.

    Raises:
        ValueError: when the folder is no run, or the run is not finished.
    """
    info = run_info(run)
    policy = load_policy(run)
    policy.half().float()  # what a reader of the file gets
    arenas = info["config"]["arenas"]
    info |= {"score": score(policy, arenas), "replay": replay_score(policy, arenas=arenas)}
    Path(folder).mkdir(parents=True, exist_ok=True)
    return save_policy(policy.half(), Path(folder) / f"{name}.safetensors", info)


def recorded_replay(name: str) -> dict[str, Any]:
    """The ``replay_score`` that a bundled policy was shipped with."""
    return policy_info(name)["replay"]


def _curve(path: Path) -> list[list[float]]:
    """(frames, value) of a training curve, averaged over stretches of it."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    return [part.mean(0).tolist() for part in np.array_split(rows, min(_POINTS, len(rows)))]
