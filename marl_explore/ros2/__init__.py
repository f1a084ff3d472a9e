"""ROS 2 nodes: they pass messages to and from ``RobotCore``, which makes all decisions.

``robot_node`` runs on a robot, ``lab_sim`` is a simulated lab for it; ``convert`` and
``parameters`` do not need ROS. docs/robots.md has topics, parameters, frames and units.
"""
