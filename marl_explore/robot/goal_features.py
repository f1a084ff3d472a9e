"""Features of one robot's choices among goals: ``policies.networks.goal_features`` in numpy.

They are computed only for choices that there are. Arrays have features first and choices last, so
that the network's weights are used as they are.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    GAIN_SQUARES,
    GOAL_COLUMNS,
    MATE_COLUMNS,
    MAX_FRONTIERS,
)
from marl_explore.config.goals import (
    BEHIND_MOVES,
    COMPUTED,
    EXCHANGE_DUE,
    EXCHANGE_EARLY,
    HALVES,
    LATE_MOVES,
    LATEST_START,
    MATE_SIZE,
    MOST_UTILITY,
    NEAR_MOVES,
    POCKET_FADE,
    SENSOR,
    SMALL_POCKET,
    STILL_SIZE,
    TEAM,
    TERMS,
)
from marl_explore.robot.candidates import Candidates, Context
from marl_explore.robot.networks import Array

Indices = NDArray[np.intp]


def _column(*numbers: float) -> Array:
    return np.array(numbers, np.float32)[:, None]


_AHEAD = np.array([*(math.cos(turn * math.pi / 4) for turn in range(5)), 0.0], np.float32)
"""By the turn; the last one is for a turn of -1, without a last move."""
_MOVES, _POCKET, _TURN, _LAST, _NEAR, _MOVE_GAIN = (
    GOAL_COLUMNS.index(name)
    for name in ("moves", "pocket", "turn", "from_last_goal", "near_gain", "move_gain")
)
_GAINS, _OF_MOVE = slice(_NEAR, _NEAR + 3), slice(_MOVE_GAIN, _MOVE_GAIN + 2)
_ROW = {name: row for row, name in enumerate(COMPUTED)}
_GAIN_ROWS = slice(_ROW["near_gain"], _ROW["far_gain"] + 1)
_OF_MOVE_ROWS = slice(_ROW["move_gain"], _ROW["allowed"] + 1)
_SHARED = ("moves", "from_last_goal", "pocket", "merged_cells", "isolation")
_SHARED_COLUMNS = [GOAL_COLUMNS.index(name) for name in _SHARED]
_SHARED_ROWS = [_ROW[name] for name in _SHARED]
_SHARED_HALVES = _column(*(HALVES[name] for name in _SHARED))
_ABOUT = [MATE_COLUMNS.index(name) for name in ("linked", "age", "unshared", "since")]
_ABOUT_HALVES = _column(HALVES["age"], HALVES["unshared"], HALVES["since"])


class Pairs(NamedTuple):
    """Features of K teammates that were seen, beside V candidate frontiers."""

    about: Array
    """[4, K]: linked, age, unshared cells, steps since the last exchange."""
    beside: Array
    """[4, K, V]: moves behind, moves late, nearness, whether it knows the place."""


class GoalFeatures(NamedTuple):
    """Features of a robot's choices: V candidate frontiers, M teammates, and standing still."""

    frontier: Array
    """[21, V], in the order ``COMPUTED``."""
    pairs: Pairs
    mate: Array
    """[MATE_SIZE, M]."""
    still: Array
    """[STILL_SIZE, 1] to communicate or to stay, else [STILL_SIZE, 0]."""
    context: Array
    """[CONTEXT_SIZE], followed by ``SENSOR`` where the sensor is read."""
    choices: list[int]
    """Numbers of the choices (``planners.goal_moves.follow``), in this order."""
    prior: Array
    """Of the choices, float32."""


class _Mates(NamedTuple):
    """What is known about all teammates, the columns ``MATE_COLUMNS``, each float32 [N]."""

    seen: Array
    linked: Array
    age: Array
    moves: Array
    move: Array
    unshared: Array
    since: Array
    square_distance: Array
    waited: Array


class _Links(NamedTuple):
    """The teammates that a robot is linked to."""

    number: int
    longest: float
    """Most steps since the last exchange with one of them."""


class Weighed(NamedTuple):
    """The places that a robot can go to: V candidate frontiers and M teammates."""

    utility: Array
    """[V + M]."""
    choices: list[int]
    """Their numbers (``planners.goal_moves.follow``), in this order."""
    due: bool
    """Whether a linked teammate has waited for an exchange for long enough."""
    places: Array
    """``GoalFeatures.frontier``, its last row not written."""
    pairs: Pairs
    visits: Indices
    """The teammates [M]."""
    mates: _Mates
    links: _Links
    moves: Array
    """Moves to the frontiers [V]."""


class _Rivalry(NamedTuple):
    """What teammates mean for V candidate frontiers."""

    price: Array
    """[V]."""
    nearer: Array
    """Number of teammates that are nearer [V]."""
    linked_nearer: Array
    """Number of linked ones [V]."""


class Utility:
    """The linear utility of choices (``planners.goal_utility``).

    Args:
        weights: in the order of ``GoalWeights`` [22].
    """

    def __init__(self, weights: Array) -> None:
        self.places = weights[:11, None]
        self.linked, scale, knowing, unknowing, arrived, memory = weights[11:17]
        self.half = -0.5 / scale
        self.fade = -1 / memory
        self.unlinked = np.array([[unknowing], [knowing - unknowing], [arrived]])
        """What a nearer teammate costs; more if it knows the place; and if it may be there."""
        self.of_moves, self.of_age, self.of_unshared = weights[17:20]
        self.timer = round(float(weights[20]))
        self.start = weights[21]

    def rivalry(self, behind: Array, knows: Array, length: Array, about: Array) -> _Rivalry:
        """What K teammates mean for V candidates.

        Args:
            behind: moves that each has more than the robot [K, V].
            knows: whether each knows the place, 0 or 1 [K, V].
            length: moves of each [K, V].
            about: whether each is linked, and steps since it was seen first [>= 2, K].
        """
        linked, age = about[0], about[1]
        terms = np.empty((4, *behind.shape), np.float32)
        # the sigmoid of -behind / scale, without an overflow
        np.tanh(behind * self.half, out=terms[0])
        terms[0] *= 0.5
        terms[0] += 0.5
        np.multiply(terms[0], knows, out=terms[1])
        np.multiply(knows, length <= age[:, None], out=terms[2])
        np.less(behind, 0, out=terms[3])
        sums = np.zeros((3, 4, len(linked)), np.float32)
        np.multiply(self.unlinked, np.exp(age * self.fade) * (1 - linked), out=sums[0, :3])
        sums[0, 0] += linked * self.linked
        sums[1, 3] = 1
        sums[2, 3] = linked
        number = 4 * len(linked)
        products = sums.reshape(3, number, 1) * terms.reshape(number, behind.shape[1])
        return _Rivalry(*np.add.reduce(products, 1))  # unlike @, to the bit equal for equal columns

    def visits(self, mates: _Mates, which: Indices) -> Array:
        """Utilities of going to teammates."""
        age, unshared = mates.age[which], mates.unshared[which]
        known = self.of_age * age / (age + HALVES["age of a visit"])
        return (
            known
            + self.of_unshared * unshared / (unshared + HALVES["unshared"])
            - self.of_moves * mates.moves[which]
        )

    def is_due(self, own: Context, links: _Links) -> bool:
        """Whether a linked teammate has waited for an exchange for long enough."""
        if not links.number or links.longest < self.timer:
            return False
        area = np.float32(own.cells) / np.float32(own.robots)
        return own.step >= round(min(float(np.sqrt(area) * self.start), LATEST_START))


class FeatureScaling:
    """Features, choices and prior of one robot.

    Args:
        weights: of the utility, in the order of ``GoalWeights`` [22].
        every: the robot may communicate every so many steps, besides when it is overdue.
        after: minimum steps since the last exchange with a linked robot before doing so.
        reads_sensor: whether the context has the robot's own sensor.
    """

    def __init__(self, weights: Array, every: int, after: int, reads_sensor: bool = False) -> None:
        self.every, self.after, self.reads_sensor = every, after, reads_sensor
        self._utility = Utility(weights)

    def __call__(self, found: Candidates) -> GoalFeatures:
        """Features of about unit size, the choices, and their prior."""
        weighed = self.weigh(found)
        places, utility, own = weighed.places, weighed.utility, found.context
        number, visits = places.shape[1], weighed.visits
        np.minimum(np.maximum(utility[:number], -MOST_UTILITY), MOST_UTILITY, out=places[-1])
        prior = utility - utility.max(initial=-np.inf)
        choices, due = weighed.choices, weighed.due
        still = _NO_STILL
        if self._talks(own, weighed.links, due, nowhere=not choices):
            still = _talk(weighed.mates, weighed.links, due)
            choices.append(MAX_FRONTIERS + own.robots)
            prior = np.append(prior, np.float32(EXCHANGE_DUE if due else EXCHANGE_EARLY))
        elif not choices:
            still, choices, prior = _STAY, [MAX_FRONTIERS + own.robots + 1], _NO_PRIOR
        visited = _of_visits(weighed.mates, visits)
        context = _context(own, weighed.links, weighed.mates.unshared, weighed.moves)
        if self.reads_sensor:
            context += [_share(getattr(own, name), HALVES[name]) for name in SENSOR]
        return GoalFeatures(
            places, weighed.pairs, visited, still, np.array(context, np.float32), choices, prior
        )

    def weigh(self, found: Candidates) -> Weighed:
        """The utility of the places to go to, and what it follows from."""
        number = int(np.count_nonzero(found.frontiers[:, _MOVES]))
        table = found.frontiers[:number].T.astype(np.float32, order="C")
        rows = found.mates.T.astype(np.float32)
        mates, own = _Mates(*rows), found.context
        longest = float((mates.since * mates.linked).max())
        links = _Links(int(np.count_nonzero(mates.linked)), longest)
        known = mates.seen.nonzero()[0]
        pairs, rivalry = self._pairs(found, table[_MOVES], rows[_ABOUT][:, known], known)
        places = self._places(table, found.frontiers[:number, _TURN], rivalry, own)
        utility = np.add.reduce(self._utility.places * places[TERMS]) - rivalry.price
        visits = _visits(mates, own)
        if len(visits):
            utility = np.append(utility, self._utility.visits(mates, visits))
        return Weighed(
            utility=utility,
            choices=[*range(number), *(visits + MAX_FRONTIERS).tolist()],
            due=self._utility.is_due(own, links),
            places=places,
            pairs=pairs,
            visits=visits,
            mates=mates,
            links=links,
            moves=table[_MOVES],
        )

    def _talks(self, own: Context, links: _Links, due: bool, nowhere: bool) -> bool:
        """Whether to communicate is a choice."""
        on_time = own.step % self.every == 0 and links.longest >= self.after
        return bool(own.may_communicate and (on_time or due or (nowhere and own.all_covered)))

    def _pairs(
        self, found: Candidates, moves: Array, about: Array, known: Indices
    ) -> tuple[Pairs, _Rivalry]:
        """``GoalFeatures.pairs``, and what the teammates mean."""
        length, knows = found.rivals[: len(moves), known].T.astype(np.float32, order="C")
        behind = length - moves
        rivalry = self._utility.rivalry(behind, knows, length, about)
        beside = np.empty((4, *behind.shape), np.float32)
        np.multiply(behind, 1 / BEHIND_MOVES, out=beside[0])
        np.subtract(behind, about[1, :, None], out=beside[1])
        beside[1] *= 1 / LATE_MOVES
        np.maximum(beside[:2], -1, out=beside[:2])
        np.minimum(beside[:2], 1, out=beside[:2])
        np.divide(NEAR_MOVES, length + NEAR_MOVES, out=beside[2])
        beside[3] = knows
        about[1:] /= about[1:] + _ABOUT_HALVES
        return Pairs(about, beside), rivalry

    @staticmethod
    def _places(table: Array, turn: NDArray[np.int32], rivalry: _Rivalry, own: Context) -> Array:
        """``GoalFeatures.frontier`` without the utility."""
        of_gains, of_move = _scales(own.radius, own.shape_cells)
        places = np.empty((len(COMPUTED), len(turn)), np.float32)
        moves, pocket, last = table[_MOVES], table[_POCKET], table[_LAST]
        shared = table[_SHARED_COLUMNS]
        np.maximum(shared, 0, out=shared)
        shared /= shared + _SHARED_HALVES
        places[_SHARED_ROWS] = shared
        one_over_moves = places[_ROW["1 / moves"]]
        np.reciprocal(moves, out=one_over_moves)
        np.log(one_over_moves, out=places[_ROW["-log"]])
        np.negative(moves, out=places[_ROW["-moves"]])
        np.multiply(one_over_moves, moves[:1], out=places[_ROW["nearest / moves"]])
        np.multiply(table[_GAINS], of_gains, out=places[_GAIN_ROWS])
        np.multiply(table[_OF_MOVE], of_move, out=places[_OF_MOVE_ROWS])
        np.exp(pocket * (-1 / POCKET_FADE), out=places[_ROW["-exp"]])
        np.less_equal(pocket, SMALL_POCKET, out=places[_ROW["small pocket"]])
        np.logical_and(last >= 0, last <= own.radius, out=places[_ROW["last_goal"]])
        places[_ROW["ahead"]] = _AHEAD[turn]
        np.equal(rivalry.linked_nearer, 0, out=places[_ROW["nearest of all"]])
        np.divide(rivalry.nearer, rivalry.nearer + HALVES["rivals"], out=places[_ROW["rivals"]])
        return places


@lru_cache
def _scales(radius: int, shape_cells: int) -> tuple[Array, Array]:
    """What makes shares of gains, and of ``move_gain`` and ``move_allowed``."""
    squares = [(2 * factor * radius + 1) ** 2 for factor in GAIN_SQUARES[1:]]
    near = 1 / shape_cells
    return _column(near, *(1 / cells for cells in squares)), _column(near, 1)


_NO_VISIT = np.empty((MATE_SIZE, 0), np.float32)
_NO_STILL = np.empty((STILL_SIZE, 0), np.float32)
_STAY = _column(*[0.0] * (STILL_SIZE - 1), 1.0)
_NO_PRIOR = np.zeros(1, np.float32)


def _share(number: float, half: float) -> float:
    """n / (n + half)."""
    return number / (number + half)


def _visits(mates: _Mates, own: Context) -> Indices:
    """Teammates that are choices."""
    if not own.all_covered:
        return np.empty(0, np.intp)
    return ((mates.linked == 0) & (mates.moves > 0)).nonzero()[0]


def _of_visits(mates: _Mates, which: Indices) -> Array:
    """``GoalFeatures.mate``."""
    if not len(which):
        return _NO_VISIT
    walk = mates.moves[which]
    about = np.stack((mates.age, mates.unshared, mates.since))[:, which]
    about /= about + _ABOUT_HALVES
    return np.concatenate(((walk / (walk + HALVES["moves"]), 1 / np.maximum(walk, 1)), about))


def _talk(mates: _Mates, links: _Links, due: bool) -> Array:
    """``GoalFeatures.still`` of communicating."""
    unshared = float(mates.unshared @ mates.linked)
    farthest = math.sqrt(float(mates.square_distance.max()))
    return _column(
        1.0,
        _share(links.longest, HALVES["since"]),
        _share(unshared, HALVES["unshared"]),
        _share(links.number, HALVES["linked"]),
        _share(farthest, HALVES["distance"]),
        due,
        float(mates.waited.max()),
        0.0,
    )


def _context(own: Context, links: _Links, unshared: Array, moves: Array) -> list[float]:
    """``GoalFeatures.context``."""
    share = float((unshared / (unshared + HALVES["unshared"])).sum())
    nearest = float(moves[0]) if len(moves) else math.inf
    return [
        _share(own.step * own.robots / max(own.cells, 1), HALVES["time"]),
        len(moves) / MAX_FRONTIERS,
        own.known_cells / max(own.cells, 1),
        _share(links.number, HALVES["linked"]),
        own.robots / TEAM,
        len(moves) > 0,
        own.all_covered,
        own.refused,
        share / max(own.robots - 1, 1),
        NEAR_MOVES / (NEAR_MOVES + nearest),
    ]
