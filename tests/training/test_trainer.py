"""Training: the same curve to the last bit, sequential updates of every part, and learning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.results import evaluate
from marl_explore.training.presets import PRESETS
from marl_explore.training.trainer import Trainer
from tests.helpers.configs import NETWORKS, tiny

SMALL = tiny(num_agents=3, num_minibatches=2)
TIMES = ("seconds", "rate")


def curve(config):
    trainer = Trainer(config)
    metrics = [{k: v for k, v in m.items() if k not in TIMES} for m in trainer.run()]
    return metrics, [p.clone() for p in parameters(trainer).values()]


def parameters(trainer):
    """Of actors and critics, by name."""
    return {
        f"{learner}.{name}": parameter
        for learner, one in trainer.learners.items()
        for name, parameter in one.loss.named_parameters()
    }


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        replace(SMALL, network=NETWORKS["cnn"], value_norm=False, num_minibatches=1),
        replace(SMALL, critic_input="state", lr_decay=True, reward="team", fpr="proximity"),
        replace(SMALL, algorithm="mappo"),
        replace(SMALL, algorithm="ippo", network=NETWORKS["cnn"]),
        replace(SMALL, algorithm="mappo", network=NETWORKS["goals"]),
        replace(SMALL, algorithm="happo", network=NETWORKS["goals"]),
    ],
    ids=["mlp", "cnn", "state critic", "mappo", "ippo", "goals", "goals of each robot"],
)
def test_the_same_seed_gives_the_same_curve_to_the_last_bit(config):
    torch.rand(7)  # whatever happened before does not matter
    one, weights = curve(config)
    torch.rand(3)
    two, again = curve(config)
    assert repr(one) == repr(two)  # repr: NaN equals NaN
    assert len(one) == config.updates == 6
    assert all(torch.equal(a, b) for a, b in zip(weights, again, strict=True))


def test_another_seed_gives_another_curve():
    assert repr(curve(SMALL)[0]) != repr(curve(replace(SMALL, seed=1))[0])


@pytest.mark.parametrize(
    ("algorithm", "networks"), [("happo", 3 + 1), ("mappo", 1 + 1), ("ippo", 3 + 3)]
)
def test_every_network_is_trained(algorithm, networks):
    trainer = Trainer(replace(SMALL, algorithm=algorithm))
    before = {name: p.clone() for name, p in parameters(trainer).items()}
    assert len(before) == networks * len(list(trainer.policy.actors[0].parameters()))
    for _ in trainer.run():
        pass
    for name, parameter in parameters(trainer).items():
        assert not torch.equal(parameter, before[name]), name


def test_step_sizes_fall_to_5_percent():
    trainer = Trainer(replace(SMALL, lr_decay=True))
    for _ in trainer.run():
        pass
    rates = [o.param_groups[0]["lr"] for o in trainer.learners["team"].optimizers.values()]
    assert rates == pytest.approx([0.05 * 5e-4] * 4)


def test_metrics_are_those_of_the_docs():
    metrics = list(Trainer(SMALL).run())[-1]
    documented = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
    for name in metrics:
        assert f"`{name}`" in documented, name


def test_a_short_run_of_the_fast_preset_beats_the_random_walk_by_far():
    config = replace(PRESETS["fast"], episodes=400)  # a sixth of the preset
    trainer = Trainer(config)
    for _ in trainer.run():
        pass
    learned = evaluate(trainer.policy, config.arena, num_arenas=60)
    walk = evaluate(find_policy("random", config.arena), config.arena, num_arenas=60)
    assert learned["steps_to_95"] <= walk["steps_to_95"] / 2
