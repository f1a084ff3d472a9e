"""Actors that choose among goals as a graph: the same logits as those that compute only choices."""

from __future__ import annotations

import pytest
import torch

from marl_explore.config.constants import FORBIDDEN_LOGIT
from marl_explore.policies.export import example_candidates
from marl_explore.policies.goal_graph import GoalGraph
from tests.helpers.goal_policies import goal_policy


@pytest.mark.parametrize(("team", "reads_sensor"), [(1, False), (2, True), (5, False)])
def test_logits_are_the_actors(team, reads_sensor):
    actor = goal_policy(reads_sensor=reads_sensor).actor_of(0)
    found = example_candidates(20, team, steps=30)
    choice, logits = GoalGraph(actor)(*found)
    with torch.no_grad():
        expected = actor(*found)
    valid = logits > -torch.inf
    assert valid.any(-1).all()
    assert torch.equal(valid, expected > FORBIDDEN_LOGIT / 2)
    torch.testing.assert_close(logits[valid], expected[valid], rtol=1e-5, atol=1e-5)
    assert torch.equal(choice, logits.argmax(-1))


def test_candidates_of_nothing_give_numbers():
    """Rows without a candidate must not spread their NaN."""
    found = example_candidates(2, 3)
    empty = found._replace(frontiers=torch.zeros_like(found.frontiers))
    _, logits = GoalGraph(goal_policy().actor_of(0))(*empty)
    assert not logits.isnan().any()
