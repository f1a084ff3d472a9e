"""Exploration on maps in metres, such as SLAM's, for a robot that something else drives to goals.

``ExplorerCore`` takes maps and poses and returns goals and a status; it has no transport, no clock
and no torch, and docs/explorer.md has its rules.
"""

from __future__ import annotations

from marl_explore.robot.explorer.core import ExplorerCore, Output
from marl_explore.robot.explorer.grids import OccupancyMap
from marl_explore.robot.explorer.places import Place
from marl_explore.robot.explorer.settings import ExplorerSettings
from marl_explore.robot.explorer.status import Status

__all__ = ["ExplorerCore", "ExplorerSettings", "OccupancyMap", "Output", "Place", "Status"]
