"""Random actions obey the mask: of the environment, through transforms, copies and collectors."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Categorical
from torchrl.envs import (
    ActionMask,
    Compose,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)
from torchrl.modules import QValueModule

from marl_explore import ExplorationEnv, make_env

ACTION, MASK = ("agents", "action"), ("agents", "action_mask")


def action_mask(key=MASK):
    return ActionMask(ACTION, key)


MAKERS = {
    "env": ExplorationEnv,
    "make_env": make_env,
    "ActionMask": lambda **kw: TransformedEnv(ExplorationEnv(**kw), action_mask()),
    "make_env, ActionMask": lambda **kw: make_env(**kw).append_transform(action_mask()),
    "chain": lambda **kw: TransformedEnv(
        ExplorationEnv(**kw), Compose(RewardSum(), action_mask(), StepCounter())
    ),
}
makers = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


def obeys(td):
    """Whether no action is forbidden, in steps that forbid some."""
    mask = td[MASK]
    assert not mask.all()
    return mask.gather(-1, td[ACTION].unsqueeze(-1)).all()


@makers
def test_random_rollouts_obey_the_mask_through_resets(make):
    env = make(num_envs=32, max_steps=7)
    for _ in range(2):
        td = env.rollout(20, break_when_any_done=False)
        assert td["step_count"].max() == 6
        assert obeys(td)
        # all that is allowed is taken by someone
        taken = torch.nn.functional.one_hot(td[ACTION], 10)
        assert taken.flatten(0, -2).any(0).all()


@makers
def test_the_specs_hold(make):
    check_env_specs(make(num_envs=3, max_steps=4))


@makers
def test_a_collector_without_a_policy_obeys_the_mask(make):
    env = make(num_envs=32, max_steps=7)
    options = {"frames_per_batch": 640, "total_frames": 1280}
    collector = Collector(env, None, **options, auto_register_policy_transforms=False)
    for batch in collector:
        assert obeys(batch)
    collector.shutdown()


@makers
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_follow_their_own_masks(make, copied):
    env = make(num_envs=32)
    now = env.rollout(3)[:, -1]["next"]
    other = copied(env)
    env.rollout(3)
    assert obeys(other.rand_action(now.clone()))
    assert obeys(other.rollout(5))


def test_a_reset_to_given_arenas_and_a_loaded_state_bring_their_masks():
    env = ExplorationEnv(num_envs=32)
    middle = env.rollout(5)[:, -1]
    saved = env.state_dict()
    now = env.step(env.rand_action())["next"]
    keys = ("obstacles", "step_count", "agents")
    assert obeys(env.rand_action(env.reset(middle.select(*keys), set_state=True)))
    env.load_state_dict(saved)
    assert obeys(env.rand_action(env.reset()))
    assert not torch.equal(now[MASK], middle[MASK])


def test_a_mask_of_ones_own_is_obeyed_in_place_of_the_current_one():
    class OnlyStay(ActionMask):
        def _call(self, next_tensordict):
            mask = torch.zeros_like(next_tensordict[MASK])
            mask[..., 8] = True
            next_tensordict.set(("agents", "only"), mask)
            return super()._call(next_tensordict)

        def transform_observation_spec(self, observation_spec):
            observation_spec["agents", "only"] = observation_spec[MASK].clone()
            return observation_spec

    env = TransformedEnv(ExplorationEnv(num_envs=4), OnlyStay(ACTION, ("agents", "only")))
    assert (env.rollout(5)[ACTION] == 8).all()


def test_environments_side_by_side_are_masked_by_the_transform():
    env = SerialEnv(2, lambda: make_env(num_envs=8)).append_transform(action_mask())
    assert obeys(env.rollout(5))


def test_specs_that_are_moved_follow_the_environment():
    env = ExplorationEnv(num_envs=32)
    moved = env.full_action_spec.clone().to("cpu")[ACTION].to(torch.int32)
    td = env.rollout(2)[:, -1]["next"]
    drawn = moved.rand()
    assert drawn.dtype == torch.int32
    assert obeys(td.set(ACTION, drawn.long()))


def test_specs_on_their_own_draw_any_action_in_their_shape():
    env = ExplorationEnv(num_envs=16)
    spec = env.full_action_spec[ACTION]
    assert spec.rand().shape == (16, 4)
    env.reset()
    assert spec.rand((50,)).shape == (50, 16, 4)
    mask = env.rollout(1)["next", MASK][:, 0].expand(50, 16, 4, 10)
    assert mask.gather(-1, spec.rand((50,)).unsqueeze(-1)).all()
    for other in (spec[:3], spec.unsqueeze(0), pickle.loads(pickle.dumps(spec))):
        assert isinstance(other, Categorical)
        drawn = other.rand((200,))
        assert drawn.shape == (200, *other.shape)
        assert len(drawn.unique()) == 10
    assert spec.is_in(torch.full((16, 4), 9))  # forbidden actions are actions


def test_value_modules_know_the_spec_as_integers():
    spec = ExplorationEnv(num_envs=2).full_action_spec["agents", "action"]
    assert QValueModule(spec=spec).action_space == "categorical"
