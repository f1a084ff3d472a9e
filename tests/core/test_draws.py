"""Draws of an episode against the slow oracle of the wider world."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.core.draws import episode_key, happens, normals, uniform
from marl_explore.core.hashing import stream_seed
from tests.helpers import world_oracle as oracle
from tests.helpers.strategies import repeatable


def keys(number):
    """Keys of the first episode of so many arenas."""
    arena = torch.arange(number)
    return episode_key(stream_seed("train", 3), arena, torch.zeros_like(arena))


def test_the_key_is_the_oracles():
    assert keys(3).tolist() == [oracle.draw_key("train", 3, arena, 0) for arena in range(3)]


@repeatable(max_examples=200)
@given(
    key=st.integers(-(2**63), 2**63 - 1),
    name=st.sampled_from(["failure", "message", "walker"]),
    indices=st.lists(st.integers(0, 10_000), min_size=1, max_size=3),
)
def test_uniform_numbers_are_the_oracles(key, name, indices):
    expected = oracle.uniform(key, name, *indices)
    assert uniform(torch.tensor([key]), name, *indices).tolist() == [expected]
    assert uniform(torch.tensor([key]), name, *map(torch.tensor, indices)).tolist() == [expected]


def test_events_happen_as_often_as_they_should():
    key, step = keys(200).unsqueeze(-1), torch.arange(200)
    for probability in (0.0, 0.1, 1.0):
        share = happens(probability, key, "failure", 0, step).double().mean()
        assert (
            abs(share - probability) < 4 * (probability * (1 - probability) / 40_000) ** 0.5 + 1e-12
        )


def test_normal_numbers_are_the_oracles():
    settings, key = oracle.Settings(shadowing_db=1.0), keys(50)
    expected = [oracle.shadowing(settings, number, 2, 1) for number in key.tolist()]
    assert normals(key, "shadow", 1, 2) == expected
