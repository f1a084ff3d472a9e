"""Robots as ROS 2 nodes: they carry messages to and from ``RobotCore``, which decides everything.

``robot_node`` runs on a robot, ``lab_sim`` is the simulated lab for it; ``convert`` and
``parameters`` need no ROS. docs/robots.md has topics, parameters, frames and units.
"""
