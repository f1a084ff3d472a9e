"""What an explorer shows: markers for RViz and diagnostics, as fields of standard messages."""

from __future__ import annotations

from marl_explore.robot.explorer import Output, Status
from marl_explore.robot.explorer.places import Point
from marl_explore.ros2.convert import OK, WARN, Fields, header_fields

_CUBES, _STRIP, _SPHERES = 6, 4, 7  # types of visualization_msgs/Marker
_SHOW, _DELETE = 0, 2  # its actions
Colour = tuple[float, float, float]
_BLUE, _GREEN, _RED = (0.1, 0.4, 1.0), (0.1, 0.8, 0.2), (0.9, 0.2, 0.1)
HEIGHT = 0.05
"""Of markers above the floor (metres)."""


def markers(
    output: Output, side: float, stamp: float, frame_id: str
) -> list[tuple[Fields, list[Point]]]:
    """visualization_msgs/Marker: frontiers, the plan, and frontiers that are left out.

    Args:
        output: of the explorer.
        side: of a coarse cell (metres).
        stamp: seconds.
        frame_id: of the map.

    Returns:
        For each marker its fields and its points (metres); one without points deletes the one that
        was shown before.
    """
    unknown = [point for cluster in output.frontiers for point in cluster]
    shown: tuple[tuple[str, int, float, Colour, list[Point]], ...] = (
        ("frontiers", _CUBES, side, _BLUE, unknown),
        ("plan", _STRIP, side / 4, _GREEN, output.plan),
        ("skipped", _SPHERES, side, _RED, output.skipped),
    )
    return [
        (
            {
                "header": header_fields(stamp, frame_id),
                "ns": name,
                "type": kind,
                "action": _SHOW if points else _DELETE,
                "pose": {"position": {"z": HEIGHT}, "orientation": {"w": 1.0}},
                "scale": {"x": size, "y": size, "z": size},
                "color": dict(zip("rgba", (*colour, 0.8), strict=True)),
            },
            points,
        )
        for name, kind, size, colour, points in shown
    ]


def status_fields(status: Status, name: str, dropped: int = 0) -> Fields:
    """diagnostic_msgs/DiagnosticStatus; ``values`` are (key, value).

    Args:
        status: of the explorer.
        name: of the robot; empty for one without a namespace.
        dropped: messages that could not be used.
    """
    counts = {
        "state": status.state,
        "known area (m2)": f"{status.known:.1f}",
        "frontiers": status.frontiers,
        "frontiers too short": status.small,
        "frontiers out of reach": status.unreachable,
        "goals reached": status.reached,
        "goals skipped": status.skipped,
        "goals given up": status.given_up,
        "frontiers that stayed": status.exhausted,
        "messages dropped": dropped,
    }
    team = {"teammate " + said.split(":")[0]: said.split(": ", 1)[1] for said in status.team}
    warns = status.state in ("waiting", "stuck") or any("refused" in said for said in status.team)
    return {
        "level": WARN if warns else OK,
        "name": f"{name}/explorer".lstrip("/"),
        "message": f"{status.state}: {status.sentence}",
        "hardware_id": name,
        "values": [(key, str(value)) for key, value in (counts | team).items()],
    }
