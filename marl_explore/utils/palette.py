"""Colours of figures and replays."""

from __future__ import annotations

# Okabe and Ito's palette: distinguishable with every kind of colour vision
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
"""One per robot or policy, in turn."""

UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR = "#B8B8B8", "#FFFFFF", "#404040"
"""Colours of cell values."""
