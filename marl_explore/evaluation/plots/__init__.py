"""Figures and animations (matplotlib): one function each, in one style.

The file's ending, such as .png, .svg or .pdf, selects the format.
"""

from __future__ import annotations

from marl_explore.evaluation.plots.episodes import (
    episode_animation,
    episode_figure,
    explored_figure,
)
from marl_explore.evaluation.plots.evaluation import (
    communication_figure,
    coverage_figure,
    enlargement_figure,
    lab_figure,
    seeds_figure,
    tradeoff_figure,
)
from marl_explore.evaluation.plots.training import training_figure
from marl_explore.utils.palette import COLORS, FREE_COLOR, OBSTACLE_COLOR, UNKNOWN_COLOR

__all__ = [
    "COLORS",
    "FREE_COLOR",
    "OBSTACLE_COLOR",
    "UNKNOWN_COLOR",
    "communication_figure",
    "coverage_figure",
    "enlargement_figure",
    "episode_animation",
    "episode_figure",
    "explored_figure",
    "lab_figure",
    "seeds_figure",
    "tradeoff_figure",
    "training_figure",
]
