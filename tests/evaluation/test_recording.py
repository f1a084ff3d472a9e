"""Episodes that end when everything is mapped: they are the beginning of whole ones."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config.constants import STAY
from marl_explore.core import motion
from marl_explore.evaluation import metrics
from marl_explore.evaluation.episodes import measure_steps, play, record
from marl_explore.evaluation.recording import EVENTS, STATES
from marl_explore.evaluation.registry import find_policy

PLAIN = ArenaConfig(height=7, width=9, num_agents=3)
HARD = ArenaConfig(
    height=8, width=10, num_agents=3, failure_rate=0.01, num_walkers=1, message_loss=0.2
)
SLOW = ArenaConfig(height=7, width=9, num_agents=3, move_period=(1, 2, 2))
ARENAS, STEPS = 12, 120


@pytest.fixture(autouse=True)
def _no_chance(monkeypatch):
    """Robots give way in one direction: what they draw depends on the size of the batch."""
    monkeypatch.setattr(motion, "random_allowed", lambda mask: mask.int().argmax(-1))


def mapped(episodes):
    """When all maps of the living are complete, or nobody lives, by plain loops; T if never."""
    first = []
    for known, alive, targets in zip(
        episodes.maps.known_targets.tolist(),
        episodes.alive.tolist(),
        episodes.num_targets.tolist(),
        strict=True,
    ):
        over = (
            t
            for t, (counts, living) in enumerate(zip(known, alive, strict=True))
            if all(count == targets for count, lives in zip(counts, living, strict=True) if lives)
        )
        first.append(next(over, episodes.horizon))
    return first


CASES = [
    (name, config)
    for name in ("nearest-timer", "goal-utility", "rendezvous", "hungarian", "best:argmax")
    for config in (PLAIN, HARD, SLOW)
]


@pytest.mark.parametrize(("name", "config"), [*CASES, ("central", PLAIN)])
def test_they_are_whole_episodes_up_to_their_end(name, config):
    policy = find_policy(name, config)
    whole = record(policy, config, ARENAS, STEPS, seed=2)
    ended = record(policy, config, ARENAS, STEPS, seed=2, until_mapped=True)
    assert whole.ended.tolist() == [STEPS] * ARENAS
    assert ended.ended.tolist() == mapped(whole)
    assert len({*ended.ended.tolist()}) > 2  # else nothing was left out
    for arena, end in enumerate(ended.ended.tolist()):
        for key in (*STATES, *EVENTS):
            before, now = getattr(whole, key)[arena], getattr(ended, key)[arena]
            assert torch.equal(before[: end + 1], now[: end + 1]), key
            after = now[end] if key in STATES else torch.zeros_like(now[end])
            assert (now[end + 1 :] == after).all(), key
        for before, now in zip(whole.maps, ended.maps, strict=True):
            assert torch.equal(before[arena, : end + 1], now[arena, : end + 1])
            assert (now[arena, end:] == now[arena, end]).all()
        assert torch.equal(whole.action[arena, :end], ended.action[arena, :end])
        assert (ended.action[arena, end:] == STAY).all()


def test_measures_of_the_way_there_are_those_of_whole_episodes():
    policy = find_policy("goal-utility", PLAIN)
    whole, ended = (
        metrics.per_episode(record(policy, PLAIN, ARENAS, STEPS, until_mapped=until))
        for until in (False, True)
    )
    differ = {name for name in whole if not torch.equal(whole[name], ended[name])}
    assert differ <= {"bytes_sent", "cells_sent", "distance_m"}
    assert (ended["bytes_sent"] < whole["bytes_sent"]).any()


def test_actions_after_the_end_do_not_count():
    policy = find_policy("goal-utility", PLAIN)
    ended = record(policy, PLAIN, ARENAS, STEPS, until_mapped=True)
    taken = metrics.communication_share(ended).whole
    assert taken.tolist() == [3 * end for end in ended.ended.tolist()]
    assert metrics.unlinked_share(ended).whole.tolist() == taken.tolist()


def test_what_failures_cost_is_asked_at_the_end_whatever_comes_later():
    policy = find_policy("hungarian", HARD)
    ended = record(policy, HARD, ARENAS, STEPS, seed=2, until_mapped=True)
    ends = ended.ended.tolist()
    assert len(set(ends)) > 2
    for end in set(ends) - {0}:
        short = record(policy, HARD, ARENAS, end, seed=2)
        for arena in (arena for arena in range(ARENAS) if ends[arena] == end):
            assert short.finishable[arena] == ended.finishable[arena]
            assert short.lost_targets[arena] == ended.lost_targets[arena]


@pytest.mark.parametrize("seed", [1, 2])
def test_it_is_asked_of_the_right_arenas_when_others_leave_at_the_last_step(seed):
    config = ArenaConfig(height=9, width=9, num_agents=3, failure_rate=0.03)
    policy = find_policy("hungarian", config)
    for steps in range(18, 28):
        whole, ended = (
            record(policy, config, 8, steps, seed=seed, until_mapped=until)
            for until in (False, True)
        )
        going_on = ended.ended == steps
        assert torch.equal(whole.finishable[going_on], ended.finishable[going_on])
        assert torch.equal(whole.lost_targets[going_on], ended.lost_targets[going_on])


class Wrapper(nn.Module):
    """Passes on what it is asked for, as compiled modules do."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, observation):
        return self.policy(observation)

    def __getattr__(self, name):
        return super().__getattr__(name) if name == "policy" else getattr(self.policy, name)


def test_wrapped_policies_forget_once():
    policy = find_policy("rendezvous", PLAIN)
    bare, wrapped = (
        record(one, PLAIN, ARENAS, STEPS, until_mapped=True) for one in (policy, Wrapper(policy))
    )
    assert torch.equal(bare.position, wrapped.position)


def test_arenas_that_are_over_are_not_stepped():
    sizes = []
    policy = find_policy("goal-utility", PLAIN)

    def counting(observation):
        sizes.append(len(observation))
        return policy(observation)

    counting.only = lambda arenas: [part.only(arenas) for part in (policy, policy._memory)]
    ended = record(counting, PLAIN, ARENAS, STEPS, until_mapped=True)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] == ARENAS
    assert sizes[-1] < ARENAS / 2
    assert len(sizes) == ended.ended.max()


def test_a_policy_that_remembers_places_can_ask_for_the_whole_batch():
    sizes = []
    policy = find_policy("goal-utility", PLAIN)

    def counting(observation):
        sizes.append(len(observation))
        return policy(observation)

    counting.whole_batch = True
    ended = record(counting, PLAIN, ARENAS, STEPS, until_mapped=True)
    assert sizes == [ARENAS] * int(ended.ended.max())


def test_episodes_of_which_none_ends_are_whole_ones():
    policy = find_policy("nearest", PLAIN)  # its robots never share their maps
    few = 4
    whole, ended = (
        record(policy, PLAIN, ARENAS, few, until_mapped=until) for until in (False, True)
    )
    for name, entry in whole._asdict().items():
        other = getattr(ended, name)
        parts = (entry, other) if name == "maps" else ((entry,), (other,))
        assert all(map(torch.equal, *parts)) if torch.is_tensor(parts[0][0]) else entry == other


def test_play_is_what_is_recorded():
    policy = find_policy("nearest-timer", PLAIN)
    torch.manual_seed(0)
    env = ExplorationEnv(PLAIN, 4, stream="test", max_steps=30)
    positions = [step["agents", "position"] for step in play(policy, env, 30)]
    assert torch.equal(record(policy, PLAIN, 4, 30).position, torch.stack(positions, 1))


def test_a_reset_alone_is_an_episode_of_no_steps():
    env = ExplorationEnv(PLAIN, 4)
    none = measure_steps([env.reset()], PLAIN)
    assert none.action.shape == (4, 0, 3)
    assert none.position.shape == (4, 1, 3, 2)
    assert none.ended.tolist() == [0] * 4
