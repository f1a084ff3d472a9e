"""Several kinds of arenas and teams in one run: padding changes nothing; runs resume exactly."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from marl_explore.policies.actors import CHOICE, CHOICE_LOG_PROB
from marl_explore.training.scenes import join_scenes
from marl_explore.training.trainer import Trainer
from marl_explore.training.worlds import random_world
from tests.helpers.configs import BY_TYPE, NETWORKS, tiny

SCENES = tiny(
    algorithm="mappo",
    network=NETWORKS["goals"],
    scenes=("uniform/1", "corridor-24/2", "uniform/4"),
    num_envs=6,
)


def test_each_scene_has_its_share_of_the_arenas():
    rollouts = Trainer(SCENES).collect()
    assert [rollout[CHOICE].shape for rollout in rollouts] == [(2, 10, 1), (2, 10, 2), (2, 10, 4)]
    batch = join_scenes(rollouts)
    assert batch[CHOICE].shape == (6, 10, 4)
    assert batch[CHOICE_LOG_PROB][:2, :, 1:].eq(0).all()


def test_kinds_of_any_size_may_have_another_side():
    scenes = ("uniform/2", "uniform-16/2", "uniform-v2-14/4", "corridor-24/4")
    configs = replace(SCENES, scenes=scenes, num_envs=8).scene_configs
    found = [(one.arenas, one.arena.height, one.arena.width) for one in configs]
    own = SCENES.arena.height, SCENES.arena.width
    assert found == [
        ("uniform", *own),
        ("uniform", 16, 16),
        ("uniform-v2", 14, 14),
        ("corridor-24", 24, 24),
    ]


def test_a_scene_may_be_in_a_random_world():
    scenes = ("uniform-14/3@5", "rooms-32/4@5", "uniform-14/3")
    here, rooms, paper = (one.arena for one in replace(SCENES, scenes=scenes).scene_configs)
    size = replace(paper, obstacle_density=0.1)
    assert here == random_world(5, size) != size
    assert (rooms.height, rooms.obstacle_density) == (32, 0.15)
    assert rooms.sensing_shape == here.sensing_shape


def test_padding_changes_no_log_probability_entropy_or_value():
    trainer = Trainer(SCENES)
    rollouts = trainer.collect()
    (learner,) = trainer.learners.values()
    actor = learner.loss.actor_losses["team"].actor_network
    batch = join_scenes(rollouts)
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
    trainer = Trainer(replace(SCENES, scenes=("uniform/2", "uniform/4")))
    two, four = trainer.collect()
    padded = join_scenes([two, four[:0]])
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


@pytest.mark.parametrize("config", [SCENES, BY_TYPE], ids=["scenes", "types"])
def test_a_run_resumes_to_the_last_bit(config):
    whole = Trainer(config)
    expected = [m for _, m in zip(range(4), whole.run(), strict=False)]
    first = Trainer(config)
    for number, _ in enumerate(first.run()):
        if number == 1:
            state = first.state_dict()
            break
    second = Trainer(config, fresh=False)
    second.load_state_dict(state)
    times = ("seconds", "rate")
    for one, other in zip(expected[2:], second.run(), strict=False):
        assert {k: repr(v) for k, v in one.items() if k not in times} == {
            k: repr(v) for k, v in other.items() if k not in times
        }


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenes": ("uniform/2", "uniform/2")}, r"scenes=.* once"),
        ({"scenes": ("uniform/0", "uniform/2")}, "scenes='uniform/0' .* such as uniform/4"),
        ({"scenes": ("uniform", "uniform/2")}, "scenes='uniform' .* such as uniform/4"),
        ({"scenes": ("uniform/two", "uniform/2")}, "scenes='uniform/two'"),
        ({"scenes": ("attic-12/2", "uniform/2")}, "attic-12"),
        ({"scenes": ("uniform-1/2", "uniform/2")}, "1 x 1 cells"),
        ({"scenes": ("uniform-/2", "uniform/2")}, "uniform-"),
        ({"scenes": ("uniform/2@", "uniform/2")}, "scenes='uniform/2@' .* number of a world"),
        ({"scenes": ("uniform/2@-1", "uniform/2")}, "number of a world must follow @"),
        ({"scenes": ("lidar-32/4@1", "uniform/2")}, "lidar-32 has a world of its own"),
        ({"scenes": ("lidar-32/2", "uniform/2")}, "scenes='lidar-32/2' .* 4 robots of its own"),
        ({"scenes": ("uniform/2", *(f"uniform/{n}" for n in (3, 4, 5)))}, "num_envs=6 .* 4 scenes"),
        ({"algorithm": "happo"}, "scenes=.* it needs algorithm='mappo'"),
        ({"network": NETWORKS["mlp"]}, "scenes=.* a network that chooses among goals"),
    ],
)
def test_scenes_that_cannot_train_together_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        replace(SCENES, **settings)
