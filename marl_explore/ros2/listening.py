"""Subscriptions that follow their publishers in the type of messages and in quality of service.

A subscription for latched messages (transient local) hears no publisher of volatile ones, and a
volatile one does not get what was latched; a reliable one hears no publisher that is best effort.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription


class _Choice(NamedTuple):
    kind: str
    reliable: bool
    latched: bool


class Listener:
    """A subscription to a topic, made anew when its publishers change.

    Until there is a publisher it hears volatile messages of the first type.

    Args:
        node: that subscribes.
        topic: relative to the node's namespace, or absolute.
        kinds: classes of messages by name, such as "nav_msgs/msg/OccupancyGrid".
        take: called with every message.
    """

    def __init__(
        self, node: Node, topic: str, kinds: Mapping[str, type], take: Callable[[Any], None]
    ) -> None:
        self.node, self.kinds, self.take = node, kinds, take
        self.topic = node.resolve_topic_name(topic)
        self._choice = _Choice(next(iter(kinds)), reliable=True, latched=False)
        self._subscription = self._subscribe()

    def update(self) -> None:
        """Look for publishers; call it about once a second."""
        infos = self.node.get_publishers_info_by_topic(self.topic)
        kind = next((kind for kind in self.kinds if any(i.topic_type == kind for i in infos)), None)
        if kind is None:
            return
        profiles = [info.qos_profile for info in infos if info.topic_type == kind]
        choice = _Choice(
            kind,
            reliable=all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles),
            latched=all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles),
        )
        if choice != self._choice:
            self.node.destroy_subscription(self._subscription)
            self._choice = choice
            self._subscription = self._subscribe()

    def problem(self) -> str | None:
        """What is missing, in a few words; None if nothing is."""
        found = {info.topic_type for info in self.node.get_publishers_info_by_topic(self.topic)}
        if not found:
            return "no publisher"
        if not found & self.kinds.keys():
            return f"published as {', '.join(sorted(found))}, not {' or '.join(self.kinds)}"
        return None

    def _subscribe(self) -> Subscription:
        kind, reliable, latched = self._choice
        profile = QoSProfile(
            depth=1,
            reliability=(ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return self.node.create_subscription(self.kinds[kind], self.topic, self.take, profile)
