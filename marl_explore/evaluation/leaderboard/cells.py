"""Cells of a leaderboard: one policy on one suite, measured once and kept as one JSON file."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from marl_explore.arenas import Suite
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.evaluation import metrics
from marl_explore.evaluation.episodes import TEST_STREAM, record, require_recording
from marl_explore.evaluation.leaderboard.entries import BOUND
from marl_explore.evaluation.leaderboard.fingerprint import Kind, outside_digest, source_digest
from marl_explore.evaluation.metrics import Episodes
from marl_explore.evaluation.registry import ARGMAX, find_policy, is_outside
from marl_explore.evaluation.stats import middle_half
from marl_explore.planners import PLANNERS, counting_bound
from marl_explore.policies.io import policy_digest
from marl_explore.utils import records
from marl_explore.utils.devices import find_device
from marl_explore.utils.files import write_text
from marl_explore.utils.json_files import digest, read_json

FORMAT = 4
"""To be increased when ``measured`` changes its content."""
HOW = ("format", "code")
"""Settings that say how a cell was measured: if only these differ, it is measured again."""
Result = dict[str, Any]
"""The content of a cell's file; see ``measure``."""


@dataclass(frozen=True)
class Cell:
    """A policy on a suite; ``settings`` has everything that its numbers depend on."""

    policy: str
    suite: Suite
    num_arenas: int
    steps: int
    seed: int
    device: str = "cpu"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that a cell's numbers depend on."""
        return {
            "format": FORMAT,
            "policy": self.policy,
            "weights": self._weights,
            "code": self._code,
            "suite": self.suite.id,
            "fingerprint": self.suite.digest,
            "arena": json.loads(json.dumps(asdict(self.suite.config))),  # tuples become lists
            "num_arenas": self.num_arenas,
            "steps": self.steps,
            "seed": self.seed,
            "stream": TEST_STREAM,
            "device": self.device,
        }

    @property
    def kind(self) -> Kind:
        """Who made the policy; the bound is a planner's."""
        if is_outside(self.policy):
            return "outside"
        return "planner" if self.policy in (*PLANNERS, BOUND) else "trained"

    @property
    def _weights(self) -> str | None:
        trained = self.kind == "trained"
        return policy_digest(self.policy.removesuffix(ARGMAX)) if trained else None

    @property
    def _code(self) -> str:
        outside = self.kind == "outside"
        return outside_digest(self.policy) if outside else source_digest(self.kind)

    @property
    def file_name(self) -> str:
        """A unique file name, whatever characters the policy's name has."""
        name = re.sub(r"[^\w.-]+", "_", self.policy)
        if name != self.policy:
            name += "-" + hashlib.sha256(self.policy.encode()).hexdigest()[:8]
        return f"{name}--{self.suite.id}.json"


def make_cells(folder: Path, cells: Iterable[Cell], progress: bool = True) -> dict[Cell, Result]:
    """The results of all cells: those in the folder are read, the others measured.

    A cell that was measured by other code is measured again.

    Args:
        folder: where every cell is written as soon as it is measured.
        cells: what to measure.
        progress: whether to show a progress bar.

    Raises:
        ValueError: before anything is measured, when a policy cannot act on a suite, or a file of
            the folder was made under other settings or is not a cell.
    """
    cells = list(dict.fromkeys(cells))
    for cell in cells:
        find_device(cell.device)
        require_recording(cell.suite.config, cell.num_arenas, cell.steps)
        if cell.policy != BOUND:
            find_policy(cell.policy, cell.suite.config)
    paths = {cell: folder / cell.file_name for cell in cells}
    kept = {cell: read(path, cell) for cell, path in paths.items() if path.exists()}
    results = {cell: result for cell, result in kept.items() if result is not None}
    folder.mkdir(parents=True, exist_ok=True)
    terminal = sys.stderr.isatty()
    with tqdm(
        total=len(cells),
        initial=len(results),
        unit="cell",
        disable=not progress,
        mininterval=0.2 if terminal else 15,  # few lines in a log file
    ) as bar:
        for cell in cells:
            if cell not in results:
                bar.set_postfix_str(f"{cell.policy} on {cell.suite.id}", refresh=terminal)
                results[cell] = measure(cell)
                write(paths[cell], results[cell])
                bar.update()
    return results


def write(path: Path, result: Result) -> None:
    """Write a cell's file, with a SHA-256 of what it holds."""
    write_text(path, json.dumps({"sha256": digest(result), **result}) + "\n")


def read(path: Path, cell: Cell) -> Result | None:
    """The result in a file; None when it was measured by other code.

    Raises:
        ValueError: when the file is not a cell, is damaged, or is that of another cell, naming the
            difference.
    """
    wanted = cell.settings
    try:
        result: Result = read_json(path)
        signed, made = result.pop("sha256", None), result.get("settings")
        if not isinstance(made, dict):
            raise ValueError("it has no settings")
        # other formats are measured again, whatever they hold
        if made.get("format") == FORMAT and signed != digest(result):
            raise ValueError("its contents do not match its SHA-256")
    except ValueError as error:
        raise ValueError(
            f"{path} is not a leaderboard cell, or is damaged: delete it to measure it again "
            f"({error})"
        ) from error
    made = {"device": "cpu"} | made  # cells of before say none
    different = [
        f"{name} was {made.get(name)!r} and now is {value!r}"
        for name, value in wanted.items()
        if name not in HOW and made.get(name) != value
    ]
    if different:
        raise ValueError(
            f"{path} was made under other settings: {'; '.join(different)}. Choose another folder, "
            "or delete the file to measure it again"
        )
    return result if all(made.get(name) == wanted[name] for name in HOW) else None


def measure(cell: Cell) -> Result:
    """Run a cell's policy on its arenas.

    Returns:
        "settings", "run" (command, versions, seconds), "planner", "reference" and "sees" of the
        policy, and ``measured``; of the bound only its "scores".
    """
    start = time.perf_counter()
    provenance = records.provenance()
    numbers = _bound(cell) if cell.policy == BOUND else _played(cell)
    seconds = round(time.perf_counter() - start, 1)
    return {
        "settings": cell.settings,
        "run": provenance | {"seconds": seconds},
        "planner": cell.policy in PLANNERS,
        **numbers,
    }


def _played(cell: Cell) -> dict[str, Any]:
    """What a policy sees, and its results."""
    policy = find_policy(cell.policy, cell.suite.config)
    episodes = record(
        policy,
        cell.suite.config,
        num_arenas=cell.num_arenas,
        steps=cell.steps,
        seed=cell.seed,
        arenas=cell.suite.arenas,
        device=cell.device,
        until_mapped=True,
    )
    return {
        "reference": bool(getattr(policy, "reference", False)),
        "sees": str(getattr(policy, "sees", "-")),
        **measured(episodes),
    }


def _bound(cell: Cell) -> dict[str, Any]:
    """The lower bound on the number of steps; there are no episodes and no other measures."""
    config = cell.suite.config
    env = ExplorationEnv(
        config, cell.num_arenas, arenas=cell.suite.arenas, seed=cell.seed, stream=TEST_STREAM
    )
    steps = counting_bound(config, env.reset())
    return {
        "reference": True,
        "sees": "no policy: cells to see / what all robots can see in a step",
        "scores": {"steps_to_100": steps.double().tolist()},
        "shares": {},
    }


def measured(episodes: Episodes) -> dict[str, Any]:
    """The data that a cell keeps from its episodes.

    Returns:
        "scores" by measure and arena; "shares" by measure: counts of events by arena, part and
        whole; over steps, "coverage" of the largest map (mean, quartiles) and mean "cells_sent" so
        far; "enlargements": how many added 0, 1, 2 ... cells; "max_discovery" (e_max).
    """
    coverage = metrics.coverage(episodes)["largest"].numpy()
    sent = metrics.cells_sent(episodes).double().mean(0)
    return {
        "scores": {k: v.tolist() for k, v in metrics.per_episode(episodes).items()},
        "shares": {
            name: {"part": share.part.tolist(), "whole": share.whole.tolist()}
            for name, share in metrics.shares(episodes).items()
        },
        "coverage": [line.tolist() for line in middle_half(coverage)],
        "cells_sent": sent.tolist(),
        "enlargements": metrics.enlargements(episodes).bincount().tolist(),
        "max_discovery": episodes.max_discovery,
    }
