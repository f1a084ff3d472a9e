"""A number that is not finite stops the run, and is named."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from marl_explore.training import runs
from marl_explore.training.checkpoint import list_checkpoints, read_checkpoint
from marl_explore.training.nan_guard import NonFiniteError
from marl_explore.training.trainer import Trainer
from tests.helpers.killing import CONFIG, RUN


def poisoned(trainer, key, row, value):
    """A trainer whose second batch has one wrong number."""
    collect = trainer.rollouts.next
    batches = 0

    def next_batch():
        nonlocal batches
        batches += 1
        (batch,) = collect()
        if batches == 2:
            batch[key][row] = value
        return [batch]

    trainer.rollouts.next = next_batch
    return trainer


@pytest.mark.parametrize(
    ("key", "row", "value", "message"),
    [
        (
            ("agents", "observation", "fpr"),
            (1, 2, 1, 5, 0),
            float("nan"),
            r"update 2: agents, observation, fpr of robot_1 is not finite: 1 of 960 values \(NaN",
        ),
        (
            ("next", "agents", "observation", "fov"),
            (1, 2, 0, 0, 0),
            float("inf"),
            r"update 2: next, agents, observation, fov of robot_0 is not .* \(infinite\)",
        ),
        (
            ("agents", "action_log_prob"),
            (0, 0),
            float("-inf"),
            r"update 2: agents, action_log_prob of robot_0, robot_1 is not finite: 2 of 40",
        ),
        (("next", "reward"), (3, 4, 0), float("nan"), "update 2: next, reward is not finite"),
    ],
)
def test_in_observations_and_rewards(key, row, value, message):
    trainer = poisoned(Trainer(CONFIG), key, row, value)
    with pytest.raises(NonFiniteError, match=message):
        list(trainer.run())
    assert trainer.updates == 1


def test_in_a_loss():
    trainer = Trainer(CONFIG)
    trainer.learners["team"].loss.actor_losses["robot_1"].entropy_coeff.fill_(float("nan"))
    with pytest.raises(NonFiniteError, match="update 1, robot_1: loss_entropy is NaN"):
        list(trainer.run())


def test_in_a_value():
    trainer = Trainer(CONFIG)
    with torch.no_grad():
        trainer.learners["team"].critic.module.layers[0].weight[0, 0] = float("inf")
    with pytest.raises(NonFiniteError, match="update 1, critic: advantage is not finite"):
        list(trainer.run())


def test_in_a_gradient():
    trainer = Trainer(CONFIG)
    weight = trainer.policy.actors[1].layers[3].weight
    weight.register_hook(lambda gradient: gradient * float("inf"))
    before = weight.clone()
    with pytest.raises(
        NonFiniteError, match=r"update 1, robot_1: the gradient of .*robot_1.*layers\.3\.weight is"
    ):
        list(trainer.run())
    assert torch.equal(weight, before)


def test_in_a_parameter_after_the_update():
    trainer = Trainer(replace(CONFIG, critic_lr=1e38, max_grad_norm=1e38))
    with pytest.raises(NonFiniteError, match=r"update 1, (critic|after the update): "):
        list(trainer.run())


def test_the_last_good_checkpoint_is_kept_and_named(tmp_path, monkeypatch):
    folder = tmp_path / "run"

    class Poisoned(Trainer):
        def update(self, batch):
            if self.updates == 7:
                with torch.no_grad():
                    self.policy.actors[0].layers[0].bias[0] = float("nan")
            return super().update(batch)

    monkeypatch.setattr(runs, "Trainer", Poisoned)
    with pytest.raises(NonFiniteError, match=r"^update 8, robot_0: .*; the last good") as e:
        runs.train(CONFIG, folder, RUN, progress=False)
    last = list_checkpoints(folder)[-1]
    assert str(last) in str(e.value)
    assert last.name == "update-00000006.safetensors"
    assert read_checkpoint(last)["trainer"]["updates"] == 6
