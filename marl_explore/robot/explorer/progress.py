"""Whether a robot comes to its goal, told from its places alone: Nav2 reports nothing."""

from __future__ import annotations

from typing import Literal

from marl_explore.robot.explorer.places import Place, Point
from marl_explore.robot.explorer.settings import ExplorerSettings

Verdict = Literal["going", "arrived", "refused", "no progress", "too late"]
STARTED = 0.1
"""A robot that has moved so far has started (metres)."""


NEAR = 2.0
"""So many times ``arrival`` from its goal a robot that comes no nearer has arrived."""


class Attempt:
    """One goal, from the moment it is sent.

    Args:
        goal: where the robot is sent.
        faces: the unknown point at the frontier; None when the robot returns to its start, or
            stands aside.
        final: whether the goal is the frontier or the start, and not a stage on the way there.
        way: length of the way to the goal (metres).
        place: where the robot is.
        time: lived time (seconds).
        settings: distances and times.
    """

    def __init__(
        self,
        goal: Place,
        faces: Point | None,
        final: bool,
        way: float,
        place: Place,
        time: float,
        settings: ExplorerSettings,
    ) -> None:
        self.goal, self.faces, self.final = goal, faces, final
        self._settings, self._began, self._from = settings, time, place
        self._deadline = time + settings.no_progress + way / settings.slowest
        self._still_since, self._still_at = time, place
        self._started = self._sent_again = False

    def judge(self, place: Place, left: float, time: float) -> Verdict:
        """How it goes.

        Args:
            place: where the robot is.
            left: length of the way to the goal that is left (metres).
            time: lived time (seconds).
        """
        settings = self._settings
        self._started |= place.distance(self._from) > STARTED
        if place.distance(self._still_at) > settings.arrival:
            self._still_since, self._still_at = time, place
        if left <= settings.arrival:
            return "arrived"
        verdict: Verdict = "going"
        if not self._started and time - self._began > settings.refusal:
            verdict = "refused"
        elif time - self._still_since > settings.no_progress:
            verdict = "no progress"
        elif time > self._deadline:
            verdict = "too late"
        if verdict != "going" and left <= NEAR * settings.arrival:
            return "arrived"  # poses may come only every half metre
        return verdict

    def send_again(self, time: float) -> bool:
        """Whether the goal should be sent once more: it may have been lost."""
        waited = time - self._began > self._settings.refusal / 2
        again = waited and not self._started and not self._sent_again
        self._sent_again |= again
        return again
