"""Validation during training, on arenas of its own, and the best policy so far."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marl_explore.arenas import default_steps
from marl_explore.config.run import RunConfig
from marl_explore.evaluation.episodes import require_recording
from marl_explore.evaluation.results import evaluate
from marl_explore.policies.io import save_policy
from marl_explore.policies.policy import Policy
from marl_explore.training.config import TrainConfig

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
"""Measures that are logged for every validation, in addition to the one for the best policy."""


def require_validation(config: TrainConfig, run: RunConfig) -> None:
    """Raise an error for validations that this machine could not hold.

    Raises:
        ValueError: naming the settings.
    """
    steps = run.validation_steps or default_steps(config.arenas)
    try:
        require_recording(config.arena, run.validation_arenas, steps)
    except ValueError as error:
        raise ValueError(
            f"validation_arenas={run.validation_arenas} of validation_steps={steps} are not "
            f"allowed: {error}"
        ) from error


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
        """Whether to validate after this update: every ``validate_every``, and after the last."""
        every = self.run.validate_every
        return every > 0 and (update % every == 0 or update == last)

    def __call__(self, policy: Policy, update: int) -> dict[str, float]:
        """The measures of ``docs/metrics.md`` under "validation_" names.

        Arenas and random numbers are the same in every validation, and the global random state is
        restored, so validation does not affect training. If scores are equal, as for policies that
        complete no map, the larger final coverage decides, then the later update.
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
                device=run.device,
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
            info = {"config": self.config.to_json(), "best": self.best}
            save_policy(policy, self.folder / BEST_FILE, info=info)
        kept = {*LOGGED, run.select_by} & set(measures)
        return {f"validation_{key}": value for key, value in measures.items() if key in kept}
