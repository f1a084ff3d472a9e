"""Figures and animations (matplotlib): one function each, in one style.

Every function writes the format that its file's ending names, such as .png, .svg or .pdf.
"""

from __future__ import annotations

from marl_explore.palette import COLORS, FREE_COLOR, OBSTACLE_COLOR, UNKNOWN_COLOR
from marl_explore.plots.episodes import episode_animation, episode_figure
from marl_explore.plots.evaluation import (
    communication_figure,
    coverage_figure,
    enlargement_figure,
    lab_figure,
    seeds_figure,
    tradeoff_figure,
)
from marl_explore.plots.training import training_figure

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
    "lab_figure",
    "seeds_figure",
    "tradeoff_figure",
    "training_figure",
]
