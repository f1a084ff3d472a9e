"""Colours of figures and replays."""

from __future__ import annotations

# Okabe and Ito's palette: distinguishable with every kind of colour vision
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
"""One per robot or policy, in turn."""

# a robot in black would know cells in the grey of unknown ones
_ROBOTS = (*COLORS[:-1], "#7A5195")
_LIGHTER, _DARKER = 0.45, 0.55


def robot_color(robot: int) -> str:
    """A colour of its own for each robot: ``COLORS``, then darker and lighter ones in turn."""
    lap, index = divmod(robot, len(COLORS))
    color = _ROBOTS[index]
    parts = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    if lap % 3 == 1:
        parts = [round(_DARKER * part) for part in parts]
    elif lap % 3 == 2:
        parts = [round(part + _LIGHTER * (255 - part)) for part in parts]
    return "#" + "".join(f"{part:02X}" for part in parts)


UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR = "#B8B8B8", "#FFFFFF", "#404040"
"""Colours of cell values."""
WALKER_COLOR = "#A3621B"
"""Of people who walk about."""
