"""Evaluation during training on arenas of its own, and the best policy so far."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marl_explore.config import ArenaConfig
from marl_explore.evaluation import TABLE_COLUMNS, evaluate
from marl_explore.execution import RunConfig
from marl_explore.policies import Policy, save_policy

STREAM = "validation"
BEST_FILE = "best.safetensors"


@dataclass
class Validation:
    """Measures a policy on fixed arenas and keeps the best one in a run folder.

    Attributes:
        best: update and score of the best policy so far; None before the first validation.
    """

    arena: ArenaConfig
    run: RunConfig
    folder: Path
    best: dict[str, Any] | None = None
    arenas: str = "uniform"

    def due(self, update: int, last: int) -> bool:
        """Whether to validate after this update: every so often, and after the last."""
        every = self.run.validate_every
        return every > 0 and (update % every == 0 or update == last)

    def __call__(self, policy: Policy, update: int) -> dict[str, float]:
        """The measures of ``docs/metrics.md`` under "validation_" names.

        Episodes and sampled actions are the same in every validation, and the global random state
        is left as it was: validating changes nothing about the run. Of equal scores the later
        one is the best.
        """
        run = self.run
        with policy.team.stacked.together():
            measures = evaluate(
                policy,
                self.arena,
                num_arenas=run.validation_arenas,
                steps=run.validation_steps,
                stream=STREAM,
                arenas=self.arenas,
            )
        score = measures[run.select_by]
        if self.best is None or score <= self.best["score"]:
            self.best = {"update": update, "measure": run.select_by, "score": score}
            save_policy(policy, self.folder / BEST_FILE, info={"best": self.best})
        kept = {*TABLE_COLUMNS.values(), run.select_by} & set(measures)
        return {f"validation_{key}": value for key, value in measures.items() if key in kept}
