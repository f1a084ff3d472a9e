"""Evidence for cells: looks change it, and robots that pass it on come to agree."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.robot.evidence import NEVER_SEEN, Evidence, EvidenceModel
from tests.helpers.boards import map_cells
from tests.helpers.strategies import repeatable

MODEL = EvidenceModel()
AWAY = (0, 3)
"""Where the robot stands, in boards of 1 x 4 cells: it is free."""


def looked(*looks, at=AWAY, model=MODEL, before=None, first=0):
    """The evidence after looks at boards, one per tick; of (board, tick), that tick."""
    known = before
    for tick, board in enumerate(looks, first):
        board, tick = board if isinstance(board, tuple) else (board, tick)
        found = map_cells(board).numpy()
        known = known or Evidence.none(*found.shape)
        known = known.looked(found, tick, model, at)
    return known


def cell(known, place=(0, 0)):
    return "?.#"[known.map[place] + 1]


def same(one, other):
    return np.array_equal(one.looks, other.looks) and np.array_equal(one.rank, other.rank)


# ---------------------------------------------------------------- looks


def test_the_first_look_decides():
    known = looked(".#?.")
    assert np.array_equal(known.map, map_cells(".#?.").numpy())
    assert (known.rank[0, 2], known.looks[0, 2]) == (NEVER_SEEN, 0)


@pytest.mark.parametrize("before", [1, 2, 3, 1000])
@pytest.mark.parametrize(("old", "new"), [".#", "#."])
def test_a_door_closes_and_a_box_goes_after_a_few_looks(old, new, before):
    known = looked(*[f"{old}??."] * before)
    history = []
    for tick in range(MODEL.limit):
        known = looked(f"{new}??.", before=known, first=before + tick)
        history.append(cell(known))
    needed = min(before, MODEL.limit)
    assert history == [old] * (needed - 1) + [new] * (MODEL.limit - needed + 1)


def test_one_wrong_look_among_many_changes_nothing():
    known = looked(*[".??."] * 5, "#??.", *[".??."])
    assert (cell(known), known.looks[0, 0]) == (".", -MODEL.limit)


def test_where_a_robot_stands_it_is_free_whatever_was_seen():
    known = looked(*["#???"] * 9)
    known = looked("####", before=known, at=(0, 0), first=9)
    assert known.looks[0, 0] == -MODEL.limit


def test_looks_change_nothing_of_what_they_look_at():
    known = looked(".#?.")
    looks, rank = known.looks.copy(), known.rank.copy()
    looked("#.#.", before=known)
    assert np.array_equal(known.looks, looks)
    assert np.array_equal(known.rank, rank)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [("limit", 0, "at least 1"), ("limit", 8, "at most 7"), ("ticks_per_look", -1, "at least 0")],
)
def test_settings_that_are_none_are_refused(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed: .*{allowed}"):
        EvidenceModel(**{name: value})


# ---------------------------------------------------------------- merging


def test_one_wrong_look_of_another_robot_does_not_beat_many_that_agree():
    many, wrong = looked(*[".??."] * 9), looked(("#??.", 12))
    assert cell(many.joined(wrong)) == cell(wrong.joined(many)) == "."


def test_a_door_that_was_closed_later_is_closed():
    """Whether its robot had known it open or not."""
    opened = looked(*[".??."] * 9)
    looks = [("#??.", 40 + tick) for tick in range(MODEL.limit)]
    for closed in (looked(*looks), looked(*looks, before=opened)):
        assert cell(opened.joined(closed)) == cell(closed.joined(opened)) == "#"


def test_what_a_robot_has_seen_is_not_undone_by_what_it_knew_before():
    """Another robot tells it of the open door again and again, while it sees that it closes."""
    opened = known = looked(*[".??."] * 9)
    history = []
    for tick in range(9, 12):
        known = looked("#??.", before=known, first=tick).joined(opened)
        history.append(cell(known))
    assert history == [".", ".", "#"]
    assert cell(opened.joined(known)) == "#"


def test_long_after_the_last_look_counts():
    old, new = looked(*[".??."] * 9), looked(("#??.", 1000))
    assert cell(old.joined(new)) == cell(new.joined(old)) == "#"


def test_unknown_cells_of_another_robot_hide_nothing():
    known = looked(".#?.")
    assert same(known.joined(Evidence.none(1, 4)), known)
    assert same(Evidence.none(1, 4).joined(known), known)


def test_ranks_of_robots_that_look_and_merge_all_the_time_do_not_run_away():
    one = other = Evidence.none(1, 4)
    for tick in range(500):
        found = map_cells(".##.").numpy()
        one, other = (known.looked(found, tick, MODEL, AWAY) for known in (one, other))
        one = one.joined(other)
        other = other.joined(one)
    assert one.rank.max() <= tick + MODEL.limit * MODEL.ticks_per_look


@st.composite
def some_evidence(draw):
    """Of 24 cells, with few different ranks, so that they often are the same."""
    looks = np.array(draw(st.lists(st.integers(-3, 3), min_size=24, max_size=24)), np.int8)
    rank = np.array(draw(st.lists(st.integers(0, 4), min_size=24, max_size=24)), np.int64)
    rank[looks == 0] = NEVER_SEEN
    return Evidence(looks.reshape(4, 6), rank.reshape(4, 6))


@repeatable(max_examples=200)
@given(some_evidence(), some_evidence(), some_evidence())
def test_merging_is_the_join_of_a_semilattice(a, b, c):
    assert same(a.joined(b), b.joined(a))
    assert same(a.joined(b).joined(c), a.joined(b.joined(c)))
    assert same(a.joined(a), a)


@repeatable(max_examples=200)
@given(some_evidence(), st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_a_look_is_above_what_it_was_made_with(known, tick, seed):
    found = np.random.default_rng(seed).integers(-1, 2, (4, 6)).astype(np.int8)
    after = known.looked(found, tick, MODEL, (1, 2))
    assert same(known.joined(after), after)
    unseen = found == -1
    unseen[1, 2] = False
    assert np.array_equal(after.rank[unseen], known.rank[unseen])
    assert (after.rank > known.rank)[~unseen].all()


@repeatable(max_examples=50)
@given(st.data())
def test_robots_that_gossip_in_any_order_end_with_equal_maps(data):
    """They look, contradict each other, tell each other in any order, and repeat old news."""
    chance = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    robots = [Evidence.none(4, 6)] * 4
    told = []
    for tick in range(30):
        one, other = chance.integers(4), chance.integers(4)
        found = chance.integers(-1, 2, (4, 6)).astype(np.int8)
        stood = int(chance.integers(4)), int(chance.integers(6))
        robots[one] = robots[one].looked(found, tick, MODEL, stood)
        told.append(robots[one])
        robots[other] = robots[other].joined(told[chance.integers(len(told))])
    orders = [reduce(Evidence.joined, [robots[i] for i in chance.permutation(4)]) for _ in robots]
    assert all(same(total, orders[0]) for total in orders)
    assert all(same(orders[0].joined(news), orders[0]) for news in told)
