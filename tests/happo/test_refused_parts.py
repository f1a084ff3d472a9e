"""Parts that the loss refuses: every error names the argument, and says what is allowed."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    FEATURES,
    ground_network,
    masked_actor,
    mlp,
)


def single_actor():
    return {"robot": masked_actor(ground_network(), "robot")}


def actors(*names):
    return {name: masked_actor(ground_network(), "agents") for name in names}


def silent_actor():
    actor = masked_actor(ground_network(), "agents")
    actor[-1].return_log_prob = False
    return actor


def two_headed_actor():
    heads = {"wheel": Categorical, "arm": Categorical}
    return ProbabilisticActor(
        TensorDictModule(
            lambda x: (x, x), ["observation"], [("params", head, "logits") for head in heads]
        ),
        in_keys=["params"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": heads},
        out_keys=[*heads],
        return_log_prob=True,
    )


def critic_of_an_actor_called_critic():
    network = ground_network()
    actor = masked_actor(network, "agents")
    return HAPPOLoss({"critic": actor}, TensorDictModule(network, ["state"], ["state_value"]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: HAPPOLoss({"a": silent_actor()}),
            r"actors\['a'\].*no log-probability.*\('agents', 'action'\).*return_log_prob=True",
        ),
        (
            lambda: HAPPOLoss({"a": TensorDictModule(ground_network(), ["x"], ["action"])}),
            r"actors\['a'\] is a TensorDictModule.*needs a ProbabilisticActor",
        ),
        (lambda: HAPPOLoss({"a": ground_network()}), r"actors\['a'\] is a Sequential"),
        (
            lambda: HAPPOLoss(single_actor(), mlp(FEATURES, 1)),
            r"critic is a Sequential.*TensorDictModule\(critic, in_keys",
        ),
        (
            lambda: HAPPOLoss(actors("a", "b")),
            r"'a' and 'b' both act for \('agents', 'action'\).*group_map=env\.group_map",
        ),
        (
            lambda: HAPPOLoss(actors("a", "b"), views={"a": ("agents", 0)}),
            "'a' and 'b' both act for",
        ),
        (
            lambda: HAPPOLoss(actors("a", "b"), views={"a": ("agents", 1), "b": ("agents", 1)}),
            "'a' and 'b' both act for",
        ),
        (
            lambda: HAPPOLoss(actors("a"), views={"a": ("agents", -1)}),
            r"views\['a'\]=\('agents', -1\).*index of 0 or more",
        ),
        (lambda: HAPPOLoss(actors("a"), views={"a": ("agents", 0.0)}), r"views\['a'\]=.*0\.0"),
        (lambda: HAPPOLoss(actors("a"), views={"a": ("agents", True)}), r"views\['a'\]=.*True"),
        (lambda: HAPPOLoss(actors("a"), views={"a": 0}), r"views\['a'\]=0 .*\(group, index\)"),
        (lambda: HAPPOLoss(actors("a"), views={"a": "agents"}), r"views\['a'\]='agents'"),
        (lambda: HAPPOLoss(single_actor(), clip_epsilon=0), "clip_epsilon=0 .* positive"),
        (lambda: HAPPOLoss(single_actor(), clip_epsilon=float("nan")), "clip_epsilon=nan"),
        (
            lambda: HAPPOLoss(single_actor(), normalize_advantage=True),
            "normalize_advantage=True is not an option.*average_gae",
        ),
        (lambda: HAPPOLoss(single_actor(), gamma=0.9), "gamma=0.9 .*make_value_estimator"),
        (lambda: HAPPOLoss(single_actor(), critic_coeff=0.5), "critic_coeff=0.5 .*scale"),
        (
            lambda: HAPPOLoss(single_actor(), loss_critic_type="l1"),
            "loss_critic_type='l1' .*mean squared error",
        ),
        (
            lambda: HAPPOLoss(single_actor(), clip_epsilom=0.3),  # ClipPPOLoss would ignore it
            "clip_epsilom=0.3 .*samples_mc_entropy",
        ),
        (lambda: HAPPOLoss(actors("robot.0")), r"the name 'robot\.0' is not allowed"),
        (lambda: HAPPOLoss(actors("items")), "the name 'items' is not allowed"),
        (lambda: HAPPOLoss(actors("")), "the name '' is not allowed"),
        (lambda: HAPPOLoss(actors(0)), "the name 0 is not allowed"),
        (critic_of_an_actor_called_critic, "'critic' and 'critic' share parameters"),
        (
            lambda: HAPPOLoss({"a": two_headed_actor()}),
            r"actors\['a'\] writes the actions \['wheel', 'arm'\].*one entry",
        ),
    ],
)
def test_parts_are_refused_at_construction(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_two_actors_may_act_on_different_entries_of_one_agent():
    """A wheel and an arm of the same robot."""
    parts = {
        name: ProbabilisticActor(
            TensorDictModule(
                nn.Linear(FEATURES, 2), [("agents", "observation")], [("agents", f"{name}_logits")]
            ),
            in_keys={"logits": ("agents", f"{name}_logits")},
            out_keys=[("agents", name)],
            distribution_class=Categorical,
            return_log_prob=True,
            log_prob_key=("agents", f"{name}_log_prob"),
        )
        for name in ("wheel", "arm")
    }
    loss = HAPPOLoss(parts, views={"wheel": ("agents", 0), "arm": ("agents", 0)})
    batch = TensorDict({"agents": {"observation": torch.randn(7, 1, FEATURES)}}, [7])
    with torch.no_grad():
        for part in parts.values():
            part(batch)
    batch["advantage"] = torch.randn(7, 1)
    assert all(loss.actor_loss(batch, name)["loss_objective"].isfinite() for name in parts)


def test_options_of_an_actor_are_passed_on():
    loss = HAPPOLoss(single_actor(), entropy_bonus=False, reduction="sum")
    assert not loss.actor_losses["robot"].entropy_bonus
    assert loss.actor_losses["robot"].reduction == "sum"


@pytest.mark.parametrize(
    "options",
    [
        {"clip_epsilon": "x"},
        {"clip_epsilon": None},
        {"clip_epsilon": True},
        {"clip_epsilon": float("nan")},
        {"clip_epsilon": (0.1, -0.2)},
        {"entropy_coeff": float("nan")},
        {"entropy_coeff": -0.1},
        {"entropy_coeff": {"move": 0.1}},
    ],
)
def test_weights_that_are_no_numbers_are_refused(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"{name}=.* is not allowed: it must be"):
        HAPPOLoss(single_actor(), **options)


def test_clipping_may_be_asymmetric():
    HAPPOLoss(single_actor(), clip_epsilon=(0.1, 0.3))
