"""Messages from other robots by tick, and counts of the messages that a robot sends."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any

from marl_explore.robot.evidence import Evidence
from marl_explore.robot.messages import Envelope, Intent, Message, Share

KEPT_TICKS = 8
"""How long messages are kept (ticks)."""
_MOST_KEPT = 64
"""Of how many ticks messages are kept: robots with another tick may be far ahead (ticks)."""


class Mailbox:
    """Incoming and outgoing messages of one robot.

    Args:
        robot: number of the robot.
    """

    def __init__(self, robot: int) -> None:
        self.robot = robot
        self.sent: Counter[str] = Counter()
        """Number of messages sent by kind, counted once for every receiver."""
        self.sent_bytes: Counter[str] = Counter()
        """Bytes of those."""
        self._intents: dict[int, dict[int, Intent]] = defaultdict(dict)
        self._shares: dict[int, dict[int, tuple[int, Share]]] = defaultdict(dict)
        self._passed: set[tuple[int, int]] = set()
        self._new: dict[int, Evidence] = {}
        self._out: list[Envelope] = []

    def receive(self, envelope: Envelope) -> None:
        """Store an intent or a share; if a share arrives twice, the first is kept."""
        message = envelope.message
        if isinstance(message, Intent):
            self._intents[message.tick][message.robot] = message
            _forget_first(self._intents)
        elif isinstance(message, Share) and message.robot != self.robot:
            shares = self._shares[message.tick]
            shares.setdefault(message.robot, (envelope.sender, message))
            _forget_first(self._shares)
            before = self._new.get(message.robot)
            new = message.evidence if before is None else before.joined(message.evidence)
            self._new[message.robot] = new

    def intents(self, tick: int, robots: Iterable[int]) -> dict[int, Intent]:
        """The intents that arrived from some robots for a tick."""
        told = self._intents.get(tick, {})
        return {robot: told[robot] for robot in robots if robot in told}

    def shared(self, tick: int, robots: Iterable[int]) -> dict[int, Evidence]:
        """Maps that arrived in a tick from some robots, also forwarded ones, by their owner."""
        return {share.robot: share.evidence for _, share in self._sent_by(tick, robots)}

    def take_new(self) -> dict[int, Evidence]:
        """What each robot's maps that arrived since the last call say together, however late."""
        new, self._new = self._new, {}
        return new

    def _sent_by(self, tick: int, robots: Iterable[int]) -> list[tuple[int, Share]]:
        members = set(robots)
        return [pair for pair in self._shares.get(tick, {}).values() if pair[0] in members]

    def send(self, message: Message, to: Iterable[int]) -> None:
        """Send a message to other robots."""
        receivers = tuple(sorted(set(to) - {self.robot}))
        if receivers:
            kind = type(message).__name__.lower()
            self.sent[kind] += len(receivers)
            letter = Envelope(self.robot, receivers, message)
            self.sent_bytes[kind] += len(receivers) * len(letter.encode())
            self._out.append(letter)

    def pass_on(self, tick: int, robots: Iterable[int]) -> None:
        """Forward every map of a tick once, so that it reaches the whole network."""
        partners = set(robots)
        for sender, share in self._sent_by(tick, partners):
            if (tick, share.robot) not in self._passed:
                self._passed.add((tick, share.robot))
                self.send(share, partners - {sender, share.robot})

    def collect(self) -> tuple[Envelope, ...]:
        """The messages to send now."""
        out, self._out = tuple(self._out), []
        return out

    def forget(self, tick: int) -> None:
        """Drop old messages at a tick."""
        last = tick - KEPT_TICKS
        for letters in (self._intents, self._shares):
            for old in [t for t in letters if t < last]:
                del letters[old]
        self._passed -= {key for key in self._passed if key[0] < last}


def _forget_first(letters: dict[int, Any]) -> None:
    """Drop the ticks that were heard of first, while there are too many."""
    while len(letters) > _MOST_KEPT:
        del letters[next(iter(letters))]
