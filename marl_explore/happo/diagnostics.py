"""What HAPPO's factor M shows of an update: statistics, and when to worry."""

from __future__ import annotations

import logging

from torch import Tensor

ESS_WARNING = 0.5
"""Effective share of the samples below which a run is warned."""

logger = logging.getLogger(__name__)


def factor_statistics(factor: Tensor) -> dict[str, float]:
    """Mean and extremes of the factor [*B, 1], and its effective sample size per sample.

    The effective sample size (Kish) is (sum M)^2 / sum M^2; over the number of samples it is 1
    where all weigh the same and 1 / samples where one outweighs all others.
    """
    return {
        "factor_mean": float(factor.mean()),
        "factor_min": float(factor.min()),
        "factor_max": float(factor.max()),
        "factor_ess": float(factor.sum() ** 2 / factor.square().sum() / factor.numel()),
    }


class FactorWatch:
    """Warns of a factor that leaves few effective samples, the first time it does."""

    def __init__(self) -> None:
        self._warned = False

    def __call__(self, share: float, update: int) -> None:
        """Look at the effective share of the samples (``factor_ess``) in an update."""
        if share >= ESS_WARNING or self._warned:
            return
        self._warned = True
        logger.warning(
            "update %d: HAPPO's factor leaves an effective sample size of %.0f %% of the batch, "
            "less than %.0f %%: actors late in the order learn from few samples. Smaller steps, "
            "fewer passes or a narrower clipping range help (said once per run)",
            update,
            100 * share,
            100 * ESS_WARNING,
        )
