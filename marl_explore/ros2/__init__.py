"""ROS 2 nodes: they pass messages to ``RobotCore`` and ``ExplorerCore``, which decide everything.

``robot_node`` runs on a robot, ``lab_sim`` is a simulated lab for it (docs/robots.md), and
``explorer_node`` explores with SLAM and Nav2 (docs/explorer.md); ``convert``, ``displays`` and the
parameters do not need ROS.
"""
