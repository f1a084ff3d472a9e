"""Maps of others: what changed is taken over, and a map that cannot be right is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.robot.evidence import Evidence, EvidenceModel
from marl_explore.robot.geometry import Frame
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.merging import Fit, MergeLimits, Moved, fit, likely_cause
from tests.helpers.boards import map_cells
from tests.helpers.strategies import repeatable

MODEL = EvidenceModel()


def seen_at(codes, *ticks):
    """Evidence of looks at a whole map; the first robot stands in a corner that is free."""
    known = Evidence.none(*codes.shape)
    for tick in ticks:
        known = known.looked(codes, tick, MODEL, (0, 0))
    return known


def rooms(seed=0, shape=(12, 12), density=0.2):
    codes = (np.random.default_rng(seed).random(shape) < density).astype(np.int8)
    codes[0, 0] = 0
    return codes


def who_knows(codes, *ticks, robots=3):
    """Robot 0 of a team, which knows that."""
    knowledge = Knowledge(0, robots, Frame(*codes.shape, 0.5))
    knowledge.merge({0: seen_at(codes, *ticks)}, 0)
    return knowledge


def patch(codes, *places):
    changed = codes.copy()
    for place in places:
        changed[place] = 1 - changed[place]
    return changed


# ---------------------------------------------------------------- what changed


def test_a_cell_that_changed_is_unshared_as_new_ones_are():
    knowledge = Knowledge(0, 3, Frame(3, 3, 0.5))
    open_door, closed = (map_cells(board).numpy() for board in ("...\n...\n...", ".#.\n...\n..."))
    assert knowledge.sense((1, 1), open_door, 0) == 9
    assert knowledge.sense((1, 1), closed, 1) == 1
    assert knowledge.unshared.tolist() == [0, 10, 10]
    assert (knowledge.known, knowledge.changes) == (9, 10)
    knowledge.merge({1: Evidence.none(3, 3)}, 1)
    assert knowledge.sense((1, 1), closed, 2) == 0
    assert knowledge.unshared.tolist() == [0, 0, 10]


def test_what_changed_reaches_robots_that_know_it_otherwise():
    codes = rooms()
    knowledge = who_knows(codes, *range(9))
    door = patch(codes, (5, 5))
    assert knowledge.merge({1: seen_at(door, 60, 61, 62)}, 63) == 1
    assert np.array_equal(knowledge.map, door)
    assert knowledge.unshared[1] == knowledge.steps_since_merge[1] == 0


def test_robots_that_know_different_parts_of_the_arena_merge():
    codes = rooms()
    north, south = codes.copy(), codes.copy()
    north[6:], south[:6] = -1, -1
    knowledge = who_knows(north, 0)
    assert knowledge.merge({1: seen_at(south, 0)}, 1) == 72
    assert np.array_equal(knowledge.map, codes)
    assert not knowledge.refused


def test_an_obstacle_where_the_robot_itself_has_been_is_free():
    codes, end = rooms(), 300
    alone = who_knows(codes, *range(9))
    before = {tuple(cell) for cell in np.argwhere(alone.map == 0)[1:3].tolist()}
    for tick, cell in enumerate(sorted(before), 9):
        alone.sense(cell, np.zeros((1, 1), np.int8), tick)
    taken = patch(codes, *before)  # the others took it for an obstacle, twice
    others = seen_at(taken, end - 2, end - 1, end)
    assert alone.merge({1: others}, end + 1) == 0
    assert np.array_equal(alone.map, codes)
    assert alone.unshared.tolist() == [0, 2, 0]
    # and they believe it, in either order
    for first, second in ((others, alone.evidence), (alone.evidence, others)):
        assert np.array_equal(first.joined(second).map, codes)
    # from the merge on, another robot's obstacle there is one
    box = sorted(before)[0]
    assert alone.merge({1: seen_at(patch(codes, box), *range(end + 40, end + 43))}, end + 50) == 1
    assert alone.map[box] == 1
    # robot 2 was not merged with since
    assert alone.merge({2: seen_at(taken, *range(end + 80, end + 83))}, end + 90) == 1
    assert np.array_equal(alone.map, codes)


def test_obstacles_where_the_robot_itself_has_been_are_no_reason_to_refuse_a_map():
    codes = rooms()
    alone = who_knows(codes, *range(9))
    way = [tuple(cell) for cell in np.argwhere(alone.map == 0)[1:31].tolist()]
    for tick, cell in enumerate(way, 9):
        alone.sense(cell, np.zeros((1, 1), np.int8), tick)
    assert alone.merge({1: seen_at(patch(codes, *way), 300, 301, 302)}, 303) == 0
    assert not alone.refusals
    assert np.array_equal(alone.map, codes)


# ---------------------------------------------------------------- what is refused


def test_a_few_doors_after_a_long_separation_are_merged():
    codes = rooms()
    doors = patch(codes, *[(1, 1), (1, 8), (4, 4), (7, 2), (9, 9)])
    knowledge = who_knows(codes, *range(9))
    assert knowledge.merge({1: seen_at(doors, 700, 701, 702)}, 703) == 5
    assert not knowledge.refusals


def test_a_map_of_other_rooms_is_refused_with_the_numbers():
    own, other = rooms(0), rooms(1)
    wrong = int((own != other).sum())
    knowledge = who_knows(own, 0)
    assert knowledge.merge({2: seen_at(other, 40, 41, 42)}, 43) == 0
    assert np.array_equal(knowledge.map, own)
    (refusal,) = knowledge.refusals
    assert refusal == (2, 43, (wrong, 144), None)
    assert knowledge.refused == {2: 1}
    assert knowledge.steps_since_merge[2] > 0
    assert str(refusal) == (
        f"the map of robot 2 at tick 43 was not merged, since it contradicts {wrong} of 144 "
        "common cells"
    )


def test_only_the_map_that_contradicts_is_refused():
    own, other = rooms(0), rooms(1)
    part = own.copy()
    part[:, 6:] = -1
    knowledge = who_knows(part, 0)
    assert knowledge.merge({2: seen_at(own, 3), 1: seen_at(other, 3)}, 4) == 72
    assert np.array_equal(knowledge.map, own)
    assert knowledge.refused == {1: 1}


def test_maps_that_contradict_each_other_are_not_both_merged():
    """The own one cannot tell which is right: the first one counts, and the other is reported."""
    knowledge = Knowledge(0, 3, Frame(12, 12, 0.5))
    knowledge.merge({2: seen_at(rooms(1), 0), 1: seen_at(rooms(0), 0)}, 1)
    assert np.array_equal(knowledge.map, rooms(0))
    assert [refusal.robot for refusal in knowledge.refusals] == [2]


def test_both_limits_must_be_exceeded():
    limits = MergeLimits(contradictions=5, share=0.1)
    assert not limits.exceeded(Fit(5, 10))
    assert limits.exceeded(Fit(6, 59))
    assert not limits.exceeded(Fit(6, 60))
    assert not limits.exceeded(Fit(0, 0))


def test_small_maps_that_mostly_contradict_are_refused():
    limits = MergeLimits()
    assert limits.exceeded(Fit(5, 9))
    assert limits.exceeded(Fit(3, 3))
    assert not limits.exceeded(Fit(2, 2))  # robots may have stood there
    assert not limits.exceeded(Fit(4, 8))


def test_reports_are_bounded_and_counted():
    knowledge = who_knows(rooms(0), 0)
    for tick in range(100):
        knowledge.merge({1: seen_at(rooms(1), tick)}, tick)
    assert knowledge.refused[1] == 100
    assert len(knowledge.refusals) == 32
    assert knowledge.refusals[-1].tick == 99


# ---------------------------------------------------------------- the likely cause


def as_seen_from(codes, quarters, east, north):
    """The map in a frame that is turned counter-clockwise about the middle, and then moved."""
    height, width = codes.shape
    moved = np.full((height + 20, width + 20), -1, np.int8)
    moved[10 : 10 + height, 10 : 10 + width] = codes
    moved = np.roll(moved, (north, -east), (0, 1))
    turned = np.rot90(moved, -quarters)
    row, column = (turned.shape[0] - height) // 2, (turned.shape[1] - width) // 2
    return turned[row : row + height, column : column + width]


@pytest.mark.parametrize("east", [-3, -1, 0, 1, 2])
@pytest.mark.parametrize("north", [-2, 0, 1, 3])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_frame_that_is_moved_or_turned_is_named(quarters, east, north):
    own = rooms()
    other = as_seen_from(own, quarters, east, north)
    knowledge = who_knows(own, 0)
    knowledge.merge({1: seen_at(other, 0)}, 1)
    moved = Moved(quarters, east, north)
    if moved == (0, 0, 0):
        assert not knowledge.refusals
    else:
        assert knowledge.refusals[0].cause == moved
        assert str(knowledge.refusals[0]).endswith(f"its frame seems to be {moved}")


@pytest.mark.parametrize("shape", [(10, 14), (9, 12), (12, 12)])
def test_a_half_turn_is_named_in_every_arena_and_a_quarter_where_cells_meet(shape):
    own, limits = rooms(shape=shape), MergeLimits()
    assert likely_cause(own, as_seen_from(own, 2, 1, 0), limits) == (2, 1, 0)
    if sum(shape) % 2 == 0:
        assert likely_cause(own, as_seen_from(own, 1, 0, 1), limits) == (1, 0, 1)


def test_causes_in_words():
    assert str(Moved(0, 1, 0)) == "moved by 1 cell east"
    assert str(Moved(0, -2, -3)) == "moved by 2 cells west and 3 cells south"
    assert str(Moved(1, 0, 0)) == "turned by 90 degrees"
    assert str(Moved(2, 0, 1)) == "turned by 180 degrees and moved by 1 cell north"


def test_a_frame_that_is_moved_further_than_is_searched_is_not_named():
    own = rooms()
    assert likely_cause(own, as_seen_from(own, 0, 5, 0), MergeLimits()) is None
    assert likely_cause(own, as_seen_from(own, 0, 5, 0), MergeLimits(search_cells=5)) == (0, 5, 0)


def test_a_frame_is_named_in_spite_of_noise_and_of_parts_that_are_unknown():
    chance = np.random.default_rng(3)
    for seed in range(10):
        own = rooms(seed)
        other = as_seen_from(own, 0, 1, -1).copy()
        other[other >= 0] ^= (chance.random((other >= 0).sum()) < 0.02).astype(np.int8)
        other[chance.random(other.shape) < 0.3] = -1
        assert likely_cause(own, other, MergeLimits()) == (0, 1, -1)


def test_other_rooms_have_no_cause():
    for seed in range(20):
        assert likely_cause(rooms(seed), rooms(seed + 100), MergeLimits()) is None


@repeatable(max_examples=100)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
def test_any_two_maps_can_be_compared(seed, height, width):
    own, other = np.random.default_rng(seed).integers(-1, 2, (2, height, width)).astype(np.int8)
    agreement = fit(own, other)
    assert 0 <= agreement.contradictions <= agreement.common <= own.size
    assert fit(other, own) == agreement
    likely_cause(own, other, MergeLimits(search_cells=16))


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("contradictions", -1, "at least 0"),
        ("share", 1.1, r"in \[0, 1\]"),
        ("search_cells", 17, "at most 16"),
    ],
)
def test_limits_that_are_none_are_refused(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed: .*{allowed}"):
        MergeLimits(**{name: value})


def test_arenas_that_are_too_large_to_share_are_refused():
    with pytest.raises(ValueError, match=r"cells=1050625 is not allowed: .*1048576"):
        Knowledge(0, 2, Frame(1025, 1025, 0.5))
