"""Policies that come with the package: bundling a run, and the scores that a replay must give."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from marl_explore.config.checks import require
from marl_explore.evaluation import metrics
from marl_explore.evaluation.episodes import record
from marl_explore.happo.diagnostics import ESS_WARNING
from marl_explore.policies.io import BUNDLED, load_policy, policy_info, save_policy
from marl_explore.policies.policy import Policy
from marl_explore.training.run_folder import is_finished, read_config, read_record
from marl_explore.utils.curves import read_curve

REPLAY_ARENAS = 20
"""Test arenas on which a bundled policy must reproduce its recorded score."""
SCORE_ARENAS = 200
STEPS = 300
_POINTS = 50
_DIGITS = 5


def replay_score(
    policy: Policy, num_arenas: int = REPLAY_ARENAS, arenas: str = "uniform"
) -> dict[str, list[int]]:
    """The exact result of a policy on the first test arenas of a kind.

    Networks compute in float64, so that the summation order of a processor has no effect.

    Args:
        policy: as ``load_policy`` returns it; it is changed to float64.
        num_arenas: B.
        arenas: kind of arenas, such as a suite's name.

    Returns:
        Per arena, steps until the largest map is complete, its known target cells at the end, and
        the cells sent by all robots.
    """
    episodes = record(policy.double(), policy.config.arena, num_arenas, STEPS, arenas=arenas)
    known = episodes.maps.known_targets.amax(-1)
    return {
        "steps_to_100": metrics.steps_to(known, episodes.num_targets, 1.0).tolist(),
        "known_targets": known[:, -1].tolist(),
        "cells_sent": metrics.cells_sent(episodes)[:, -1].tolist(),
    }


def run_info(run: str | Path) -> dict[str, Any]:
    """The information about a finished run: configuration, record, and curves of all measures.

    Of HAPPO's factor also the smallest effective sample size, and how many updates were below that
    at which a run warns (half of the batch), which curves of means do not show.

    Raises:
        ValueError: when the folder is not a run, or the run is not finished.
    """
    run = Path(run)
    config, how = read_config(run), read_record(run)
    if not is_finished(run):
        raise ValueError(f"the run in {run} is not finished: resume it first")
    paths = sorted((run / "scalars").glob("*.csv"))
    info = {
        "config": config.to_json(),
        "run": how.to_json(),
        "curves": {path.stem: _curve(path) for path in paths},
    }
    if (ess := run / "scalars" / "factor_ess.csv").is_file():
        sizes = read_curve(ess)[:, 1]
        low = int((sizes < ESS_WARNING).sum())
        info["factor_ess"] = {"least": float(sizes.min()), "warnings": low, "updates": len(sizes)}
    return info


def score(policy: Policy, arenas: str = "uniform") -> dict[str, float]:
    """Every measure of a policy on 200 test arenas of a kind."""
    return metrics.summarize(
        record(policy, policy.config.arena, SCORE_ARENAS, STEPS, arenas=arenas)
    )


def bundle(run: str | Path, name: str, folder: str | Path = BUNDLED) -> Path:
    """Bundle the policy of a finished run with the package, with weights in float16.

    Its file also holds the ``run_info``, and the ``score`` and ``replay_score`` of the weights as
    shipped, on arenas of the kind that the run was trained on.

    Args:
        run: folder of a finished run.
        name: name for ``load_policy``.
        folder: where it is written; created if it does not exist.

    Raises:
        ValueError: when the folder is not a run, the run is not finished, or the name is not one.
    """
    require_name(name)
    info = run_info(run)
    policy = load_policy(run)
    policy.half().float()  # the weights that are read from the file
    arenas = info["config"]["arenas"]
    info |= {"score": score(policy, arenas), "replay": replay_score(policy, arenas=arenas)}
    Path(folder).mkdir(parents=True, exist_ok=True)
    return save_policy(policy.half(), Path(folder) / f"{name}.safetensors", info)


def require_name(name: str) -> None:
    """Raise an error for a name that cannot be a bundled policy's, such as one with a folder.

    Raises:
        ValueError: naming it.
    """
    allowed = "use letters, digits, and . _ - after the first"
    require(re.fullmatch(r"[A-Za-z0-9][\w.-]*", name) is not None, "name", name, allowed)


def recorded_replay(name: str) -> dict[str, Any]:
    """The ``replay_score`` that a bundled policy was shipped with."""
    return policy_info(name)["replay"]


def _curve(path: Path) -> list[list[float]]:
    """(frames, value) of a training curve, averaged over sections of it, to five digits."""
    rows = read_curve(path)
    parts = np.array_split(rows, min(_POINTS, len(rows)))
    return [[float(f"{number:.{_DIGITS}g}") for number in part.mean(0)] for part in parts]
