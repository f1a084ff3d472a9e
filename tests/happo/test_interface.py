"""The loss as a module: keys, state, parameters, and what it refuses."""

from __future__ import annotations

import copy

import pytest
import torch
from torchrl.modules import (
    RunningValueNorm,
)
from torchrl.objectives.utils import ValueEstimators

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    CLIP,
    GAMMA,
    LMBDA,
    NAMES,
    VIEWS,
    assert_same_losses,
    descend,
    episodes,
    ground_network,
    make_team,
    masked_actor,
    perturb,
)

# ------------------------------------------------------------- the module's interface

RENAMED = {
    "advantage": ("estimates", "gain"),
    "value_target": ("estimates", "return"),
    "value": "worth",
    "factor": ("estimates", "weight"),
    "reward": "team_reward",
    "done": "over",
    "terminated": "finished",
}
WRITTEN = ("advantage", "value_target", "factor")


@pytest.mark.parametrize("value_norm", [None, RunningValueNorm], ids=["plain", "norm"])
@pytest.mark.parametrize("keys_first", [True, False], ids=["keys first", "estimator first"])
def test_renamed_keys(value_norm, keys_first):
    # GAE checks that the critic writes the value key, so that one must be set before.
    names = RENAMED if keys_first else {**RENAMED, "value": "state_value"}
    team = make_team(value_norm=value_norm and value_norm())
    team.loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    torch.manual_seed(0)  # the same networks and batch once more
    renamed = make_team(value_key=names["value"], value_norm=value_norm and value_norm())
    if not keys_first:
        renamed.loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    renamed.loss.set_keys(**names)
    if keys_first:
        renamed.loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)

    plain = team.batch.exclude("advantage", "value_target")
    other = plain.clone()
    for key in ("reward", "done", "terminated"):
        other.rename_key_(("next", key), ("next", names[key]))
    for each, batch in ((team, plain), (renamed, other)):
        each.loss.estimate_advantage(batch)
        torch.manual_seed(1)
        for robot in (2, 0):
            perturb(each.networks[robot])
            each.loss.update_factor(batch, NAMES[robot])
    for key, default in (("value", "state_value"), *((k, k) for k in WRITTEN)):
        assert torch.equal(plain[default], other[names[key]]), key
    assert not set(WRITTEN) & set(other.keys())
    assert_same_losses(team.loss(plain), renamed.loss(other))


@pytest.mark.parametrize("renamed", [{}, {"reward": "gain", "done": ("end", "all")}], ids=str)
def test_an_update_reads_the_rollout_s_keys_and_no_others(renamed):
    team = make_team()
    team.loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    team.loss.set_keys(**renamed)
    whole = team.batch.exclude("advantage", "value_target")
    for key, name in renamed.items():
        whole["next", name] = whole["next"].pop(key)
    kept = whole.select(*team.loss.rollout_keys)
    for batch in (whole, kept):
        team.loss.estimate_advantage(batch)
        for name in NAMES[:2]:
            team.loss.update_factor(batch, name)
    assert_same_losses(team.loss(whole), team.loss(kept))
    for key in team.loss.rollout_keys:
        with pytest.raises(ValueError, match="has no entry"):
            team.loss(
                team.loss.estimate_advantage(whole.select(*team.loss.rollout_keys).exclude(key))
            )


def test_forward_returns_all_losses_at_the_factor_of_the_batch():
    team = make_team()
    for network in team.networks:
        perturb(network)
    team.loss.update_factor(team.batch, "robot_1")
    flat = team.batch.reshape(-1)
    output = team.loss(flat)

    diagnostics = ("entropy", "clip_fraction", "kl_approx", "ESS", "mean_ratio", "max_ratio")
    parts = ("loss_objective", "loss_entropy", *diagnostics)
    expected = {f"{part}_{name}" for part in parts for name in NAMES}
    assert set(output.keys()) == expected | {"loss_critic", "explained_variance"}
    assert set(team.loss.out_keys) <= set(output.keys())
    assert all(value.shape == () for value in output.values())
    for name in NAMES:
        losses = team.loss.actor_loss(flat, name)
        assert all(torch.equal(output[f"{part}_{name}"], losses[part]) for part in parts)
    assert torch.equal(output["loss_critic"], team.loss.critic_loss(flat)["loss_critic"])


def test_forward_reads_in_keys_and_no_more():
    team = make_team()
    assert_same_losses(team.loss(team.batch), team.loss(team.batch.select(*team.loss.in_keys)))


def test_forward_estimates_a_missing_advantage_without_touching_the_batch():
    team = make_team()
    batch = team.batch.exclude("advantage", "value_target")
    keys = set(batch.keys(True, True))
    output = team.loss(batch)
    assert set(batch.keys(True, True)) == keys
    assert_same_losses(output, team.loss(team.loss.estimate_advantage(batch)))


def test_state_dict_round_trip():
    trained, fresh = (make_team(value_norm=RunningValueNorm()) for _ in range(2))
    for team in (trained, fresh):
        team.loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    trained.loss.estimate_advantage(trained.batch)
    optimizer = torch.optim.Adam(trained.loss.parameters(), lr=1e-2)
    descend(optimizer, trained.loss(trained.batch))

    batch = trained.batch.exclude("advantage", "value_target")
    fresh.loss.load_state_dict(copy.deepcopy(trained.loss.state_dict()))
    first = trained.loss.estimate_advantage(batch.clone())
    second = fresh.loss.estimate_advantage(batch.clone())
    assert torch.equal(first["advantage"], second["advantage"])
    assert_same_losses(trained.loss(first), fresh.loss(second))


def test_parameters_are_those_of_the_modules_each_once():
    team = make_team(value_norm=RunningValueNorm())
    team.loss.make_value_estimator()
    expected = [id(p) for module in team.modules for p in module.parameters()]
    assert sorted(expected) == sorted(id(p) for p in team.loss.parameters())


# --------------------------------------------------------------------------- errors


def test_unknown_actor():
    team = make_team()
    for call in (team.loss.actor_loss, team.loss.update_factor):
        with pytest.raises(ValueError, match=r"'robot_9' is unknown.*robot_0.*robot_3"):
            call(team.batch, "robot_9")


def test_view_of_an_unknown_actor():
    with pytest.raises(ValueError, match=r"views\['scout'\].*\['robot'\]"):
        HAPPOLoss(
            {"robot": masked_actor(ground_network(), "robot")}, views={"scout": ("agents", 0)}
        )


@pytest.mark.parametrize("shared_part", ["network", "layer"])
def test_shared_parameters(shared_part):
    first, second = ground_network(), ground_network()
    if shared_part == "network":
        second = first
    else:
        second[0] = first[0]
    actors = {"left": masked_actor(first, "agents"), "right": masked_actor(second, "agents")}
    views = {"left": ("agents", 0), "right": ("agents", 1)}
    with pytest.raises(ValueError, match=r"'left' and 'right' share parameters"):
        HAPPOLoss(actors, views=views)


def test_missing_critic():
    loss = HAPPOLoss({"robot": masked_actor(ground_network(), "robot")})
    batch = episodes()
    with pytest.raises(ValueError, match="critic_loss needs a critic"):
        loss.critic_loss(batch)
    for call in (loss.estimate_advantage, loss):
        with pytest.raises(ValueError, match="value estimation needs a critic"):
            call(batch)


def test_actors_without_a_critic_still_have_losses():
    team = make_team()
    actors = {n: masked_actor(net, "agents") for n, net in zip(NAMES, team.networks, strict=True)}
    bare = HAPPOLoss(actors, views=VIEWS, clip_epsilon=CLIP)
    expected = team.loss(team.batch).exclude("loss_critic", "explained_variance")
    assert_same_losses(bare(team.batch), expected)
    assert "loss_critic" not in bare.out_keys


def test_other_estimators_than_gae():
    with pytest.raises(NotImplementedError, match="with GAE, not"):
        make_team().loss.make_value_estimator(ValueEstimators.TD0)


def test_unknown_key():
    with pytest.raises(ValueError, match="adventage is not an accepted tensordict key"):
        make_team().loss.set_keys(adventage="gain")
