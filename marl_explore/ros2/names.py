"""Names that parameters give: namespaces, topics and frames, as ROS allows them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from marl_explore.config.checks import require

_TOKENS = r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
_NAMESPACE, _TOPIC = re.compile(_TOKENS), re.compile(rf"(/|~/)?{_TOKENS}")
_LONGEST = 100
"""Characters of a name; topics of ROS have about 250."""


def require_team(team: Sequence[str]) -> None:
    """Require namespaces of robots, each of them once."""
    for name in team:
        allowed = (
            f"{name!r} is no namespace: it must be letters, digits and _, such as robot_1, "
            "without a slash before it"
        )
        require(_fits(name, _NAMESPACE), "team", team, allowed)
    require(len({*team}) == len(team), "team", team, "a robot is in it twice")


def own_name(namespace: str, team: Sequence[str]) -> str:
    """The robot of a team whose node has a namespace, such as "/robot_1" or "/fleet/robot_1".

    Of no robot: the namespace without slashes around it.
    """
    fitting = [name for name in team if f"/{namespace.strip('/')}".endswith(f"/{name}")]
    return max(fitting, key=len, default=namespace.strip("/"))


def team_root(namespace: str, own: str) -> str:
    """What stands before the namespaces of a team, with a slash after it: "/" or "/fleet/".

    Args:
        namespace: of the node, such as "/fleet/robot_1"; of one that runs elsewhere, anything else.
        own: the robot's name in the team, such as "robot_1".
    """
    if namespace.endswith(f"/{own}"):
        return namespace.removesuffix(own)
    return "/"


def require_topic(name: str, topic: str, in_team: bool = False) -> None:
    """Require the name of a topic; in a team a relative one, which each robot has."""
    allowed = "it must be a topic: letters, digits, _ and /, such as map"
    require(_fits(topic, _TOPIC), name, topic, allowed)
    hint = (
        "in a team it must be relative, since it is looked for under the namespace of each robot; "
        f"where the own one is elsewhere, remap it: -r {topic.lstrip('~/')}:={topic}"
    )
    require(not (in_team and topic[0] in "/~"), name, topic, hint)


def frame_id(name: str, frame: str) -> str:
    """The name of a frame without a slash before it, as tf has it.

    Raises:
        ValueError: naming the parameter, when it is empty.
    """
    plain = frame.lstrip("/") if isinstance(frame, str) else ""
    require(bool(plain.strip()), name, frame, "it must be the name of a frame, such as map")
    return plain


def _fits(name: object, pattern: re.Pattern[str]) -> bool:
    return isinstance(name, str) and len(name) <= _LONGEST and bool(pattern.fullmatch(name))
