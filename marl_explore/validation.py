"""Evaluation during training on arenas of its own, and the best policy so far."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from marl_explore.config import TrainConfig
from marl_explore.evaluation import evaluate
from marl_explore.execution import RunConfig
from marl_explore.policies import Policy, save_policy

STREAM = "validation"
BEST_FILE = "best.safetensors"
LOGGED = (
    "steps_to_95",
    "steps_to_100",
    "complete",
    "coverage_at_50",
    "coverage_at_150",
    "communication_share",
    "useful_share",
    "overlap",
)
"""Measures that are kept of every validation, beside the one that chooses the best policy."""


@dataclass
class Validation:
    """Measures a policy on fixed arenas and keeps the best one in a run folder.

    Attributes:
        best: update and score of the best policy so far; None before the first validation.
    """

    config: TrainConfig
    run: RunConfig
    folder: Path
    best: dict[str, Any] | None = None

    def due(self, update: int, last: int) -> bool:
        """Whether to validate after this update: every so often, and after the last."""
        every = self.run.validate_every
        return every > 0 and (update % every == 0 or update == last)

    def __call__(self, policy: Policy, update: int) -> dict[str, float]:
        """The measures of ``docs/metrics.md`` under "validation_" names.

        Episodes and sampled actions are the same in every validation, and the global random state
        is left as it was: validating changes nothing about the run. Of equal scores, such as of
        policies that complete no map, the larger final coverage decides, then the later one.
        """
        run = self.run
        with policy.team.stacked.together():
            measures = evaluate(
                policy,
                self.config.arena,
                num_arenas=run.validation_arenas,
                steps=run.validation_steps,
                stream=STREAM,
                arenas=self.config.arenas,
            )
        score = measures[run.select_by]
        coverage = measures["final_largest_coverage"]
        if self.best is None or (score, -coverage) <= (self.best["score"], -self.best["coverage"]):
            self.best = {
                "update": update,
                "measure": run.select_by,
                "score": score,
                "coverage": coverage,
            }
            info = {"config": asdict(self.config), "best": self.best}
            save_policy(policy, self.folder / BEST_FILE, info=info)
        kept = {*LOGGED, run.select_by} & set(measures)
        return {f"validation_{key}": value for key, value in measures.items() if key in kept}
