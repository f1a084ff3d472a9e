"""When robots communicate."""

from __future__ import annotations

import torch

from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.planners import GainThreshold, PairTimer, SharedClock, never
from tests.helpers.situations import on_board


def said(rule, env, td, steps):
    """Who communicated at each step, everyone else staying."""
    history = []
    for _ in range(steps):
        communicating = rule(td)
        history.append(communicating[0].tolist())
        action = torch.where(communicating, COMMUNICATE, STAY)
        td = env.step(td.set(("agents", "action"), action))["next"]
    return history


def test_the_pair_timer_talks_to_strangers_and_then_waits():
    env, td = on_board("0.1.....", 1, 8, communication_range=1.0)
    rule = PairTimer(3)
    both, nobody = [True, True], [False, False]
    assert said(rule, env, td, 6) == [both, nobody, nobody, nobody, both, nobody]


def test_the_pair_timer_does_not_talk_out_of_range():
    _, td = on_board("0...1", 1, 5, communication_range=1.0)
    assert not PairTimer(3)(td).any()


def test_a_shared_clock_strikes_for_robots_in_range():
    env, td = on_board("0.1...2", 1, 7, communication_range=1.0)
    rule = SharedClock(2, 3)
    pair, nobody = [True, True, False], [False, False, False]
    assert said(rule, env, td, 7) == [nobody, nobody, pair, nobody, nobody, pair, nobody]


def test_the_gain_threshold_counts_what_a_robot_has_to_give():
    _, td = on_board("0.1..", 1, 5, communication_range=1.0)
    assert td["agents", "unshared"].tolist() == [[[0, 2], [3, 0]]]
    assert GainThreshold(2)(td).tolist() == [[True, True]]
    assert GainThreshold(3)(td).tolist() == [[False, True]]
    _, apart = on_board("0.1..", 1, 5, communication_range=0.5)
    assert GainThreshold(2)(apart).tolist() == [[False, False]]


def test_never_is_never():
    _, td = on_board("01", 1, 2)
    assert never(td).tolist() == [[False, False]]
