"""The paper's lab in simulation: robots with wheels and lidars execute grid actions (extra "lab").

Physics and lidar are those of VMAS, which is licensed under the GPLv3 and imported only when a lab
is created.
"""

from __future__ import annotations

from marl_explore.lab.measures import LabRecord
from marl_explore.lab.planner_policy import planner_policies
from marl_explore.lab.runner import LabRunner, exported_policies
from marl_explore.lab.world import LabWorld, Noise

__all__ = [
    "LabRecord",
    "LabRunner",
    "LabWorld",
    "Noise",
    "exported_policies",
    "planner_policies",
]
