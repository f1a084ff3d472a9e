"""Maps as bytes: they come back, are small, and whatever is no map is refused."""

from __future__ import annotations

import math
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.robot import decode
from marl_explore.robot.evidence import MOST_LOOKS, NEVER_SEEN, Evidence, EvidenceModel
from marl_explore.robot.messages import Share
from marl_explore.robot.packing import MOST_CELLS, OLDEST
from tests.helpers.strategies import repeatable

HEAD = Share._FORMAT


def explored(side, ticks, seed=0):
    """What a robot knows that has wandered through random boxes."""
    chance = np.random.default_rng(seed)
    boxes = (chance.random((side, side)) < 0.2).astype(np.int8)
    known, cell, model = Evidence.none(side, side), np.array([side // 2] * 2), EvidenceModel()
    for tick in range(ticks):
        found = np.full((side, side), -1, np.int8)
        part = tuple(slice(max(place - 1, 0), place + 2) for place in cell)
        found[part] = boxes[part]
        known = known.looked(found, tick, model, tuple(cell.tolist()))
        cell = np.clip(cell + chance.integers(-1, 2, 2), 0, side - 1)
    return known, ticks - 1


def same(one, other):
    return np.array_equal(one.looks, other.looks) and np.array_equal(one.rank, other.rank)


@pytest.mark.parametrize(("side", "ticks"), [(12, 1), (12, 60), (12, 2000), (64, 3000)])
def test_what_a_robot_knows_comes_back_from_its_bytes(side, ticks):
    known, tick = explored(side, ticks)
    share = decode(Share(3, tick, known).encode())
    assert (share.robot, share.tick) == (3, tick)
    assert same(share.evidence, known)
    assert np.array_equal(share.map, known.map)


@repeatable(max_examples=100)
@given(st.data())
def test_any_evidence_comes_back(data):
    """Ranks are at most as far ahead as the most looks that there can be are worth."""
    height, width = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    cells, tick = height * width, data.draw(st.integers(0, 2**53))
    every = {"min_size": cells, "max_size": cells}
    looks = np.array(data.draw(st.lists(st.integers(-7, 7), **every)), np.int8)
    ages = np.array(data.draw(st.lists(st.integers(-200, 50_000), **every)), np.int64)
    rank = np.where(looks == 0, NEVER_SEEN, np.maximum(tick - ages, 0))
    known = Evidence(looks.reshape(height, width), rank.reshape(height, width))
    assert same(decode(Share(1, tick, known).encode()).evidence, known)


def test_looks_that_are_too_old_to_tell_are_as_old_as_can_be_told():
    known, _ = explored(12, 60)
    tick = 1_000_000
    told = decode(Share(0, tick, known).encode()).evidence
    assert np.array_equal(told.looks, known.looks)
    seen = known.looks != 0
    assert (tick - told.rank[seen] <= OLDEST).all()
    assert (tick - told.rank[seen] > OLDEST - 300).all()


@pytest.mark.parametrize(
    ("side", "ticks", "most"), [(12, 60, 180), (12, 2000, 260), (64, 3000, 5200)]
)
def test_maps_are_small(side, ticks, most):
    known, tick = explored(side, ticks)
    assert len(Share(0, tick, known).encode()) <= most


# ---------------------------------------------------------------- what is no map


def packed(raw, height=2, width=2, tick=9, end=b""):
    return HEAD.pack(2, 1, tick, height, width) + zlib.compress(raw) + end


def ages(*ticks):
    """Low bytes, then high bytes."""
    return bytes(age & 255 for age in ticks) + bytes(age >> 8 for age in ticks)


WHOLE = bytes([0, 255, 0, 3]) + ages(200, 200)  # one look for free, three for occupied


def test_the_bytes_that_the_next_tests_break_are_a_map():
    share = decode(packed(WHOLE))
    assert share.map.tolist() == [[-1, 0], [-1, 1]]
    assert share.evidence.rank.tolist() == [[-1, 9 + 255 - 200 + 8], [-1, 9 + 255 - 200 + 24]]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (packed(WHOLE[:-1]), "2 x 2 cells has 8 bytes unpacked, not 7"),
        (packed(WHOLE + b"\0"), "2 x 2 cells has 8 bytes unpacked, not 9"),
        (packed(WHOLE[:3]), "2 x 2 cells has"),
        (packed(b""), "2 x 2 cells has"),
        (packed(WHOLE, width=3), "2 x 3 cells has"),
        (packed(WHOLE + bytes(99)), "not one packed map of at most 12 bytes"),
        (packed(WHOLE, end=b"\0"), "not one packed map"),
        (packed(WHOLE)[:-1], "not one packed map"),
        (packed(WHOLE)[: HEAD.size], "not one packed map"),
        (packed(WHOLE)[: HEAD.size + 2] + b"\xff\xff", "cannot be unpacked"),
        (packed(WHOLE, tick=2**63), "tick=9223372036854775808 is not allowed"),
        (packed(bytes([0, 0, 0, MOST_LOOKS + 1]) + ages(200)), "more than 7 looks"),
        (packed(bytes([0, 0, 0, 128]) + ages(200)), "more than 7 looks"),
        (packed(bytes([0, 0, 0, 1]) + ages(OLDEST)), "before the first tick"),
        (
            HEAD.pack(2, 1, 5, 65535, 65535),
            f"65535 x 65535 cells is too large: at most {MOST_CELLS}",
        ),
        (HEAD.pack(2, 1, 5, 2, 2)[:-1], "bytes"),
    ],
)
def test_broken_maps_are_refused(data, message):
    with pytest.raises(ValueError, match=f"broken message Share: .*{message}"):
        decode(data)


def test_bytes_that_unpack_to_gigabytes_take_no_memory():
    bomb = zlib.compress(bytes(100_000_000), 9)
    for size in ((2, 2), (1024, 1024), (65535, 65535)):
        tracemalloc.start()
        with pytest.raises(ValueError, match="broken message Share"):
            decode(HEAD.pack(2, 1, 5, *size) + bomb)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < 8 * MOST_CELLS  # three bytes per cell, twice


def test_damaged_bytes_are_refused_or_are_a_map():
    known, tick = explored(12, 60)
    whole, chance = Share(0, tick, known).encode(), np.random.default_rng(0)
    refused = 0
    for _ in range(3000):
        data = bytearray(whole)
        if chance.random() < 0.3:
            del data[chance.integers(len(data)) :]
        else:
            for _ in range(chance.integers(1, 4)):
                data[chance.integers(1, len(data))] = chance.integers(256)
        refused += not is_map(bytes(data))
    assert refused > 2800  # zlib has a sum of its own


@repeatable(max_examples=300)
@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_are_a_map(data):
    is_map(b"\x02" + data)


@repeatable(max_examples=300)
@given(st.binary(max_size=40), st.integers(0, 4), st.integers(0, 4), st.integers(0, 2**64 - 1))
def test_any_bytes_unpacked_are_refused_or_are_a_map(raw, height, width, tick):
    is_map(packed(raw, height, width, tick))


def is_map(data):
    """Whether bytes are a map, as robots use it; everything else is one kind of error."""
    try:
        share = decode(data)
    except ValueError:
        return False
    known = share.evidence
    assert known.map.shape == known.rank.shape
    assert (np.abs(known.looks) <= MOST_LOOKS).all()
    assert ((known.rank == NEVER_SEEN) == (known.looks == 0)).all()
    assert math.prod(known.map.shape) <= MOST_CELLS
    return True
