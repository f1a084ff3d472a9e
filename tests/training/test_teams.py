"""Teams of several sizes in one run: padding changes nothing, and runs resume exactly."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from marl_explore.policies.actors import CHOICE, CHOICE_LOG_PROB
from marl_explore.training.teams import join_teams
from marl_explore.training.trainer import Trainer
from tests.helpers.configs import NETWORKS, tiny

TEAMS = tiny(algorithm="mappo", network=NETWORKS["goals"], team_sizes=(1, 2, 4), num_envs=6)


def test_each_team_size_has_its_share_of_the_arenas():
    rollouts = Trainer(TEAMS).collect()
    assert [rollout[CHOICE].shape for rollout in rollouts] == [(2, 10, 1), (2, 10, 2), (2, 10, 4)]
    batch = join_teams(rollouts)
    assert batch[CHOICE].shape == (6, 10, 4)
    assert batch[CHOICE_LOG_PROB][:2, :, 1:].eq(0).all()


def test_padding_changes_no_log_probability_entropy_or_value():
    trainer = Trainer(TEAMS)
    rollouts = trainer.collect()
    (learner,) = trainer.learners.values()
    actor = learner.loss.actor_losses["team"].actor_network
    batch = join_teams(rollouts)
    with torch.no_grad():
        joined = actor.get_dist(batch)
        values = learner.critic(batch.clone())["state_value"]
        for number, rollout in enumerate(rollouts):
            rows, robots = slice(2 * number, 2 * number + 2), rollout[CHOICE].shape[-1]
            alone = actor.get_dist(rollout)
            found = joined.log_prob(batch[CHOICE])[rows]
            assert_close(found[..., :robots], alone.log_prob(rollout[CHOICE]))
            assert_close(found[..., :robots], rollout[CHOICE_LOG_PROB])
            assert found[..., robots:].eq(0).all()
            entropy = joined.entropy()[rows]
            assert_close(entropy[..., :robots], alone.entropy())
            assert entropy[..., robots:].eq(0).all()
            value = learner.critic(rollout.clone())["state_value"]
            assert_close(values[rows], value)


def test_padding_adds_no_gradient():
    """The loss of a padded rollout is that of the rollout, but for the mean over more robots."""
    trainer = Trainer(replace(TEAMS, team_sizes=(2, 4)))
    two, four = trainer.collect()
    padded = join_teams([two, four[:0]])
    assert padded[CHOICE].shape == (3, 10, 4)
    (learner,) = trainer.learners.values()
    advantage = torch.randn(3, 10, 1)
    gradients = []
    for batch in (two, padded):
        batch = batch.clone().set("advantage", advantage)
        output = learner.loss.actor_loss(batch, "team")
        loss = output["loss_objective"] + output["loss_entropy"]
        parameters = [*learner.loss.actor_losses["team"].parameters()]
        gradients.append(torch.autograd.grad(loss, parameters))
    for alone, with_padding in zip(*gradients, strict=True):
        assert_close(2 * with_padding, alone)


def test_a_run_of_teams_resumes_to_the_last_bit():
    whole = Trainer(TEAMS)
    expected = [m for _, m in zip(range(4), whole.run(), strict=False)]
    first = Trainer(TEAMS)
    for number, _ in enumerate(first.run()):
        if number == 1:
            state = first.state_dict()
            break
    second = Trainer(TEAMS, fresh=False)
    second.load_state_dict(state)
    times = ("seconds", "rate")
    for one, other in zip(expected[2:], second.run(), strict=False):
        assert {k: repr(v) for k, v in one.items() if k not in times} == {
            k: repr(v) for k, v in other.items() if k not in times
        }


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"team_sizes": (2, 2)}, r"team_sizes=\(2, 2\) .* once"),
        ({"team_sizes": (0, 2)}, "team_sizes=0"),
        ({"team_sizes": (2, 3, 4, 5)}, "num_envs=6 .* the 4 team sizes need equal shares"),
        ({"algorithm": "happo"}, "team_sizes=.* it needs algorithm='mappo'"),
        ({"network": NETWORKS["mlp"]}, "team_sizes=.* a network that chooses among goals"),
    ],
)
def test_teams_that_cannot_train_together_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        replace(TEAMS, **settings)
