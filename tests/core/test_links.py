"""Ranges and networks: who hears whom, directly and through relays."""

from __future__ import annotations

import math

import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from marl_explore.core.communication import networks
from marl_explore.core.grid import COMMUNICATE
from marl_explore.core.links import RADIOS, any_linked, within_range
from tests.helpers.boards import actions, arena


def pairs(matrix):
    """Pairs (i, j), i < j, of a symmetric matrix bool [N, N]."""
    assert matrix.equal(matrix.T)
    return {(i, j) for i, j in matrix.nonzero().tolist() if i < j}


def networks_of(board, range_cells, names):
    """The members of each network, as a set of tuples."""
    _, position = arena(board)
    together = networks(within_range(position, range_cells), actions(names) == COMMUNICATE)
    assert together.equal(together.T)
    members = together.diagonal().nonzero().flatten().tolist()
    return {tuple(together[member].nonzero().flatten().tolist()) for member in members}


# ---------------------------------------------------------------- range


@pytest.mark.parametrize(
    ("range_cells", "near"),
    [
        (0.99, set()),
        (1, {(0, 1)}),
        (1.41, {(0, 1)}),
        (1.42, {(0, 1), (0, 2)}),
        (2.23, {(0, 1), (0, 2)}),
        (2.24, {(0, 1), (0, 2), (1, 2)}),
    ],
)
def test_distances_are_euclidean_between_cell_centres(range_cells, near):
    _, position = arena("""
        .01
        2..
    """)  # 1 from robot 0 to 1, sqrt 2 from 0 to 2, sqrt 5 from 1 to 2
    assert pairs(within_range(position, range_cells)) == near


@pytest.mark.parametrize("range_cells", [0, 0.5, 6.4, math.inf])
def test_every_robot_is_in_range_of_itself(range_cells):
    _, position = arena("0....1")
    assert within_range(position, range_cells).diagonal().all()


@pytest.mark.parametrize(
    ("range_m", "cell_size", "cells"),
    [(0.3, 0.1, 3), (0.7, 0.1, 7), (2.1, 0.7, 3), (1.5, 0.5, 3)],
)
def test_exactly_the_range_is_in_range_in_spite_of_rounding(range_m, cell_size, cells):
    config = ArenaConfig(
        cell_size=cell_size, sensing_range=3 * cell_size, communication_range=range_m
    )
    position = torch.tensor([[0, 0], [0, cells], [cells + 1, 0]])
    assert pairs(within_range(position, config.communication_cells)) == {(0, 1)}


def test_the_rounding_slack_is_no_more_than_that():
    position = torch.tensor([[0, 0], [0, 3]])
    assert pairs(within_range(position, 3 - 1e-6)) == set()


def test_with_range_0_nobody_hears_anybody():
    _, position = arena("01\n2.")
    assert pairs(within_range(position, 0)) == set()


@pytest.mark.parametrize("range_cells", [math.inf, 1e12])
def test_with_a_boundless_range_everybody_hears_everybody(range_cells):
    position = torch.tensor([[0, 0], [0, 1], [9999, 9999]])
    assert pairs(within_range(position, range_cells)) == {(0, 1), (0, 2), (1, 2)}


def test_has_neighbor_needs_another_robot():
    _, position = arena("0.1...2")
    assert any_linked(within_range(position, 2)).tolist() == [True, True, False]
    _, alone = arena("0")
    assert any_linked(within_range(alone, math.inf)).tolist() == [False]


# ---------------------------------------------------------------- networks


def test_two_communicators_in_range_form_a_network():
    assert networks_of("0.1", 2, "talk talk") == {(0, 1)}


def test_a_lone_communicator_forms_no_network():
    assert networks_of("0.1", 2, "talk stay") == set()
    assert networks_of("0.1", 1, "talk talk") == set()
    assert networks_of("0", math.inf, "talk") == set()


def test_a_chain_of_three_joins_ends_that_are_out_of_range():
    assert networks_of("0.1.2", 2, "talk talk talk") == {(0, 1, 2)}


@pytest.mark.parametrize("board", ["0.1.2.3", "3.0.2.1"])
def test_a_chain_of_four_joins_ends_that_are_out_of_range(board):
    assert networks_of(board, 2, "talk talk talk talk") == {(0, 1, 2, 3)}


@pytest.mark.parametrize("robots", [5, 6, 9, 10])
def test_long_chains_relay_from_end_to_end(robots):
    position = torch.tensor([[0, 2 * robot] for robot in range(robots)])
    together = networks(within_range(position, 2), torch.ones(robots, dtype=torch.bool))
    assert together.all()


def test_a_silent_robot_does_not_relay():
    assert networks_of("0.1.2", 2, "talk stay talk") == set()
    assert networks_of("0.1.2.3", 2, "talk talk stay talk") == {(0, 1)}
    assert networks_of("0.1.2", 2, "talk E talk") == set()


def test_networks_apart_stay_apart():
    assert networks_of("0.1...2.3", 2, "talk talk talk talk") == {(0, 1), (2, 3)}
    assert networks_of("0.2...1.3", 2, "talk talk talk talk") == {(0, 2), (1, 3)}


def test_a_lone_communicator_beside_a_network_is_in_none():
    assert networks_of("0.1...2", 2, "talk talk talk") == {(0, 1)}


def test_arenas_of_a_batch_have_their_own_networks():
    positions = torch.stack([arena("0.1....")[1], arena("0.....1")[1]])
    communicating = torch.tensor([[True, True], [True, True]])
    together = networks(within_range(positions, 2), communicating)
    assert together.tolist() == [[[True, True], [True, True]], [[False, False], [False, False]]]


# ---------------------------------------------------------------- radios of one's own


@pytest.mark.parametrize(
    ("linked", "message"),
    [
        (torch.ones(2, 4, 4), "must return a bool tensor of shape .2, 4, 4., got torch.float32"),
        (torch.ones(4, 4).bool(), "must return a bool tensor .* got torch.bool of shape .4, 4."),
        (torch.ones(2, 4, 4).triu().bool(), "must return a symmetric relation"),
        (torch.zeros(2, 4, 4).bool(), "must return .* True on its diagonal"),
    ],
)
def test_a_radio_must_give_a_symmetric_relation(monkeypatch, linked, message):
    monkeypatch.setitem(RADIOS, "mine", lambda *_: linked)
    env = ExplorationEnv(ArenaConfig(radio="mine"), num_envs=2)
    with pytest.raises(ValueError, match=f"radio='mine' {message}"):
        env.reset()


def test_everybody_reads_what_a_radio_says(monkeypatch):
    monkeypatch.setitem(RADIOS, "all", lambda *_: torch.ones(2, 4, 4, dtype=torch.bool))
    td = make_env(ArenaConfig(radio="all", communication_range=0.0), num_envs=2).reset()
    assert td["agents", "linked"].all()
    assert td["agents", "observation", "net"].eq(1).all()
    assert td["agents", "action_mask"][..., COMMUNICATE].all()


@pytest.mark.parametrize(
    "settings",
    [
        {"communication_range": 1e200},
        {"communication_range": (1e200, 1e200, math.inf, math.inf)},
        {"shadowing_db": 30.0, "path_loss_exponent": 0.1},
        {"shadowing_db": 1e300, "path_loss_exponent": 1e-300, "wall_loss_db": 1e300},
    ],
)
def test_no_radio_is_too_strong(settings):
    td = ExplorationEnv(ArenaConfig(**settings), num_envs=3).rollout(3)
    linked = td["agents", "linked"]
    assert linked.equal(linked.mT)
