"""Diagnostics of HAPPO's factor M: statistics, and a warning."""

from __future__ import annotations

import logging

from torch import Tensor

ESS_WARNING = 0.5
"""Effective sample size, as a share of the batch, below which a warning is logged."""

logger = logging.getLogger(__name__)


def factor_statistics(factor: Tensor) -> dict[str, float]:
    """Mean, minimum and maximum of the factor [*B, 1], and its relative effective sample size.

    The effective sample size (Kish) is (sum M)^2 / sum M^2. Divided by the number of samples it is
    1 if all have the same weight, and 1 / samples if one outweighs all others.
    """
    return {
        "factor_mean": float(factor.mean()),
        "factor_min": float(factor.min()),
        "factor_max": float(factor.max()),
        "factor_ess": float(factor.sum() ** 2 / factor.square().sum() / factor.numel()),
    }


class FactorWatch:
    """Warns, once, when few samples are effective."""

    def __init__(self) -> None:
        self._warned = False

    def __call__(self, share: float, update: int) -> None:
        """Check an update's relative effective sample size (``factor_ess``)."""
        if share >= ESS_WARNING or self._warned:
            return
        self._warned = True
        logger.warning(
            "update %d: HAPPO's factor leaves an effective sample size of %.0f %% of the batch, "
            "less than %.0f %%: actors late in the order learn from few samples. Smaller steps, "
            "fewer passes or a narrower clipping range help (logged only once)",
            update,
            100 * share,
            100 * ESS_WARNING,
        )
