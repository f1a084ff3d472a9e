"""Batches that the loss refuses: every error names the entry, and says what to do."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Normal
from torchrl.modules import ProbabilisticActor

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    ACTIONS,
    ARENAS,
    FEATURES,
    ROBOTS,
    STEPS,
    continuous_actor,
    drone_network,
    episodes,
    ground_network,
    make_team,
    masked_actor,
    mlp,
    rollout,
    state_critic,
    with_advantage,
)

SHAPE = (ARENAS, STEPS)


def single_actor():
    return {"robot": masked_actor(ground_network(), "robot")}


def actors(*names):
    return {name: masked_actor(ground_network(), "agents") for name in names}


# ------------------------------------------------------------------ entries of a batch


@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("advantage", r"loss\.estimate_advantage\(rollout\) first.*set_keys\(advantage=\.\.\.\)"),
        (("agents", "action_log_prob"), r"return_log_prob=True.*set_keys\(.*sample_log_prob="),
        (("agents", "action"), r"actor 'robot_1' reads it.*set_keys\(action="),
        (("agents", "observation"), "actor 'robot_1' reads it"),
        (("agents", "action_mask"), "actor 'robot_1' reads it"),
    ],
)
@pytest.mark.parametrize("call", ["actor_loss", "update_factor"])
def test_a_missing_entry_of_an_actor(key, remedy, call):
    team = make_team()
    batch = team.batch.exclude(key)
    if (call, key) == ("update_factor", "advantage"):  # which reads none
        assert "factor" in team.loss.update_factor(batch, "robot_1")
        return
    name = ".*".join(map(str, key)) if isinstance(key, tuple) else key
    with pytest.raises(ValueError, match=f"no entry .*{name}.*{remedy}"):
        getattr(team.loss, call)(batch, "robot_1")


def test_a_missing_entry_of_an_actor_without_a_view():
    loss = HAPPOLoss(single_actor())
    batch = with_advantage(rollout(robot={"observation": torch.randn(*SHAPE, FEATURES)}))
    with pytest.raises(ValueError, match=r"no entry \('robot', 'action_mask'\): actor 'robot'"):
        loss.actor_loss(batch, "robot")


def test_the_name_of_the_log_probability_can_be_set():
    team = make_team()
    expected = team.loss.actor_loss(team.batch, "robot_0")
    batch = team.batch.rename_key_(("agents", "action_log_prob"), ("agents", "old"))
    with pytest.raises(ValueError, match="action_log_prob"):
        team.loss.actor_loss(batch, "robot_0")
    team.loss.actor_losses["robot_0"].set_keys(sample_log_prob=("agents", "old"))
    got = team.loss.actor_loss(batch, "robot_0")
    assert torch.equal(got["loss_objective"], expected["loss_objective"])


@pytest.mark.parametrize("key", ["value_target", ("agents", "observation")])
def test_a_missing_entry_of_the_critic(key):
    team = make_team()
    remedy = "estimate_advantage" if key == "value_target" else "the critic reads it"
    with pytest.raises(ValueError, match=f"no entry .*{key[-1][-5:]}.*{remedy}"):
        team.loss.critic_loss(team.batch.exclude(key))


@pytest.mark.parametrize(
    "key",
    [("next", key) for key in ("reward", "done", "terminated", "state")] + ["state", "next"],
    ids=str,
)
def test_a_rollout_without_what_gae_reads(key):
    loss = HAPPOLoss(single_actor(), state_critic())
    missing = r"'next', 'reward'" if key == "next" else str(key).strip("()")
    with pytest.raises(ValueError, match=f"no entry .*{missing}"):
        loss.estimate_advantage(episodes().exclude(key))


def test_steps_that_gae_marks_as_invalid():
    loss = HAPPOLoss(single_actor(), state_critic())
    with pytest.raises(ValueError, match="shifted=True is not allowed"):
        loss.make_value_estimator(shifted=True)


def test_a_collector_without_next_observations():
    loss = HAPPOLoss(single_actor(), state_critic())
    with pytest.raises(ValueError, match=r"\('next', 'state'\).*compact_obs=False"):
        loss.estimate_advantage(episodes().exclude(("next", "state")))


@pytest.mark.parametrize("name", ["reward", "done", "terminated"])
def test_entries_of_the_agents_are_not_the_team_s(name):
    loss = HAPPOLoss(single_actor(), state_critic())
    batch = episodes()
    team = batch["next"].pop(name)
    batch["next", "agents"] = {name: team.unsqueeze(-2).expand(-1, -1, 3, -1)}
    before = set(batch.keys(True, True))
    with pytest.raises(
        ValueError,
        match=rf"no entry \('next', '{name}'\): .*\[2, 8, 1\].*batch\['next', group, '{name}'\]\."
        rf"(mean|any)\(-2\).*set_keys\({name}=\.\.\.\)"
        rf".*the batch has \('next', 'agents', '{name}'\) \[2, 8, 3, 1\]",
    ):
        loss.estimate_advantage(batch)
    loss.set_keys(**{name: ("agents", name)})
    with pytest.raises(ValueError, match=rf"'{name}'\) has shape \[2, 8, 3, 1\].*\[2, 8, 1\]"):
        loss.estimate_advantage(batch)
    assert set(batch.keys(True, True)) == before
    batch["next", "team"] = {name: team}
    loss.set_keys(**{name: ("team", name)})
    assert loss.estimate_advantage(batch)["advantage"].isfinite().all()


@pytest.mark.parametrize("first", ["critic_loss", "estimate_advantage", "make_value_estimator"])
def test_a_critic_that_writes_another_key_may_be_named_later(first):
    loss = HAPPOLoss(single_actor(), state_critic("worth"))
    batch = episodes()
    batch["value_target"] = torch.randn(2, 8, 1)
    if first == "make_value_estimator":
        loss.make_value_estimator(gamma=0.9)
    for call in (loss.critic_loss, loss.estimate_advantage):
        with pytest.raises(
            ValueError, match=r"writes \['worth'\], not .*'state_value'.*set_keys\(value='worth'\)"
        ):
            call(batch)
    loss.set_keys(value="worth")
    loss.estimate_advantage(batch)
    assert batch["worth"].shape == (2, 8, 1)
    loss.critic_loss(batch)["loss_critic"].backward()  # the failed calls have frozen nothing
    assert all(p.grad.isfinite().all() for p in loss.critic.parameters())


def test_a_value_per_agent_is_not_the_team_s():
    team = make_team()
    critic = TensorDictModule(
        mlp(FEATURES, 1), [("agents", "observation")], [("agents", "state_value")]
    )
    loss = HAPPOLoss(actors("a"), critic)
    loss.set_keys(value=("agents", "state_value"))
    per_agent = rf"'state_value'\) has shape \[6, 11, {ROBOTS}, 1\].*\[6, 11, 1\]"
    for call in (loss.critic_loss, loss.estimate_advantage):
        with pytest.raises(ValueError, match=per_agent):
            call(team.batch)


@pytest.mark.parametrize("key", ["advantage", "factor", "value_target"])
@pytest.mark.parametrize("shape", [SHAPE, (*SHAPE, ROBOTS), (*SHAPE, 1, 1), (*SHAPE, ROBOTS, 1)])
def test_a_shape_that_would_be_broadcast(key, shape):
    team = make_team()
    team.batch[key] = torch.rand(shape)
    call = team.loss.critic_loss if key == "value_target" else team.loss.actor_loss
    rest = () if key == "value_target" else ("robot_0",)
    with pytest.raises(ValueError, match=rf"'{key}' has shape .*must have \[6, 11, 1\]"):
        call(team.batch, *rest)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite(value):
    team = make_team()
    for key in ("advantage", "factor", "value_target"):
        batch = team.batch.clone()
        batch[key] = torch.rand(*SHAPE, 1)
        batch[key][2, 3] = value
        call = team.loss.critic_loss if key == "value_target" else team.loss.actor_loss
        rest = () if key == "value_target" else ("robot_0",)
        with pytest.raises(FloatingPointError, match="not finite in 1 of 66 samples"):
            call(batch, *rest)


@pytest.mark.parametrize("shape", [(0,), (0, 10), (4, 0)])
def test_a_batch_without_samples(shape):
    team = make_team()
    empty = team.batch.reshape(-1)[:0].reshape(*shape)
    calls = [
        lambda: team.loss.actor_loss(empty, "robot_0"),
        lambda: team.loss.update_factor(empty, "robot_0"),
        lambda: team.loss.critic_loss(empty),
        lambda: team.loss.estimate_advantage(empty),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=rf"the batch of shape \[{shape[0]}.*has no samples"):
            call()


def test_a_single_step_has_no_advantage_to_normalise():
    loss = HAPPOLoss(single_actor(), state_critic())
    batch = episodes()[:1, :1]
    with pytest.raises(ValueError, match=r"\[1, 1\] is a single step.*average_gae=False"):
        loss.estimate_advantage(batch)
    loss.make_value_estimator(average_gae=False)
    assert loss.estimate_advantage(batch)["advantage"].isfinite().all()
    with pytest.raises(ValueError, match=r"needs a rollout \[\*B, T\]"):
        loss.estimate_advantage(batch[0, 0])


@pytest.mark.parametrize("call", ["actor_loss", "update_factor", "critic_loss"])
def test_padding_is_refused_by_every_loss(call):
    team = make_team()
    team.batch["collector"] = {"mask": torch.ones(*SHAPE, dtype=torch.bool)}
    rest = () if call == "critic_loss" else ("robot_0",)
    with pytest.raises(ValueError, match="split_trajs=False"):
        getattr(team.loss, call)(team.batch, *rest)


# -------------------------------------------------------------------- log-probabilities


@pytest.mark.parametrize("call", ["actor_loss", "update_factor"])
@pytest.mark.parametrize("continuous", [False, True])
def test_a_log_probability_of_another_shape(call, continuous):
    if continuous:
        actor = continuous_actor(drone_network(), "robot")
        batch = rollout(robot={"observation": torch.randn(*SHAPE, 3)})
    else:
        actor = masked_actor(ground_network(), "robot")
        mask = torch.ones(*SHAPE, ACTIONS, dtype=torch.bool)
        batch = rollout(robot={"observation": torch.randn(*SHAPE, FEATURES), "action_mask": mask})
    loss = HAPPOLoss({"robot": actor})
    with torch.no_grad():
        batch = with_advantage(actor(batch))
    batch["robot", "action_log_prob"] = batch["robot", "action_log_prob"].unsqueeze(-1)
    with pytest.raises(ValueError, match=r"action_log_prob'\) has shape \[6, 11, 1\]"):
        getattr(loss, call)(batch, "robot")


def test_a_log_probability_with_an_axis_that_the_action_has_too():
    """Only the actor knows whether it is of one component or of the whole action."""

    def actor(**options):
        return ProbabilisticActor(
            TensorDictModule(nn.Linear(FEATURES, 1), ["observation"], ["loc"]),
            in_keys=["loc"],
            distribution_class=Normal,
            distribution_kwargs={"scale": 1.0},
            return_log_prob=True,
            **options,
        )

    loss = HAPPOLoss({"robot": actor()})
    batch = TensorDict({"observation": torch.randn(5, FEATURES)}, [5])
    with torch.no_grad():
        loss.actor_losses["robot"].actor_network(batch)
    assert loss.update_factor(batch.clone(), "robot")["factor"].shape == (5, 1)
    batch["action_log_prob"] = batch["action_log_prob"].squeeze(-1)
    with pytest.raises(ValueError, match=r"has shape \[5\], but actor 'robot' gives \[5, 1\]"):
        loss.update_factor(batch, "robot")


@pytest.mark.parametrize("stored", [-1.0, -torch.inf, torch.nan])
def test_an_action_that_the_mask_forbids_has_no_ratio(stored):
    team = make_team()
    team.loss.update_factor(team.batch, "robot_0")
    before = team.batch["factor"].clone()
    action = team.batch["agents", "action"][1, 2, 3]
    mask = team.batch["agents", "action_mask"]
    mask[1, 2, 3] = True
    mask[1, 2, 3, action] = False
    team.batch["agents", "action_log_prob"][1, 2, 3] = stored
    with pytest.raises(
        ValueError, match=r"'robot_3' has no probability for 1 of 66 actions.*mask forbids"
    ):
        team.loss.update_factor(team.batch, "robot_3")
    assert torch.equal(team.batch["factor"], before)


def test_a_factor_that_overflows():
    team = make_team()
    team.batch["agents", "action_log_prob"] -= 100
    with pytest.raises(FloatingPointError, match="the factor after actor 'robot_0' is not finite"):
        team.loss.update_factor(team.batch, "robot_0")
    assert "factor" not in team.batch
