"""HAPPO on the groups of real TorchRL environments, with views from their ``group_map``."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    MarlGroupMapType,
    PettingZooWrapper,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
    VmasEnv,
)
from torchrl.modules import GRUModule, ProbabilisticActor, TanhNormal

from marl_explore import HAPPOLoss, sequential_update
from tests.helpers.happo import descend, parameters_of, perturb

pytestmark = pytest.mark.filterwarnings("ignore")  # of TorchRL, and of the environments' packages

ROOT = Path(__file__).parents[3]
FRAMES = 60


@pytest.fixture(autouse=True)
def _recipes_are_found(monkeypatch):
    torch.manual_seed(0)
    monkeypatch.syspath_prepend(ROOT / "recipes")


def balance(group_map) -> EnvBase:
    options = {} if group_map is None else {"group_map": group_map}
    return VmasEnv("balance", num_envs=6, continuous_actions=True, seed=0, **options)


def mpe(name: str) -> EnvBase:
    env = importlib.import_module(f"mpe2.{name}").parallel_env(max_cycles=FRAMES + 1)
    return PettingZooWrapper(env, seed=0)


MAPS: dict[str, tuple[Callable[[], EnvBase], dict[str, list[str]]]] = {
    "one group": (
        lambda: balance(MarlGroupMapType.ALL_IN_ONE_GROUP),
        {"agents": ["agent_0", "agent_1", "agent_2"]},
    ),
    "group per agent": (
        lambda: balance(MarlGroupMapType.ONE_GROUP_PER_AGENT),
        {name: [name] for name in ("agent_0", "agent_1", "agent_2")},
    ),
    "default": (lambda: balance(None), {"agents": ["agent_0", "agent_1", "agent_2"]}),
    "by hand": (
        lambda: balance({"pair": ["agent_2", "agent_0"], "rest": ["agent_1"]}),
        {"pair": ["agent_2", "agent_0"], "rest": ["agent_1"]},
    ),
    "pettingzoo": (
        lambda: mpe("simple_spread_v3"),
        {"agent": ["agent_0", "agent_1", "agent_2"]},
    ),
    "pettingzoo, unlike agents": (
        lambda: mpe("simple_speaker_listener_v4"),
        {"speaker": ["speaker_0"], "listener": ["listener_0"]},
    ),
}


def make_critic(env: EnvBase) -> TensorDictSequential:
    keys = [(group, "observation") for group in env.group_map]
    features = sum(env.observation_spec[key].shape[-2:].numel() for key in keys)
    return TensorDictSequential(
        TensorDictModule(lambda *e: torch.cat([x.flatten(-2) for x in e], -1), keys, ["joint"]),
        TensorDictModule(nn.Linear(features, 1), ["joint"], ["state_value"]),
    )


def make_loss(env: EnvBase, owners: dict[str, str]) -> HAPPOLoss:
    """Owners: per actor, the group of its agent."""
    make_actor = importlib.import_module("fitting_networks").make_actor
    actors = {name: make_actor(env, group, (16,)) for name, group in owners.items()}
    return HAPPOLoss(actors, make_critic(env), group_map=env.group_map)


def collect(env: EnvBase, loss: HAPPOLoss):
    collector = Collector(
        env,
        loss.make_policy(),
        frames_per_batch=FRAMES,
        total_frames=FRAMES,
        auto_register_policy_transforms=False,
    )
    (batch,) = (batch.clone() for batch in collector)
    collector.shutdown()
    rewards = [batch["next", group, "reward"].mean(-2) for group in env.group_map]
    batch["next", "reward"] = torch.stack(rewards).mean(0)
    return batch


@pytest.mark.parametrize("case", MAPS)
@pytest.mark.parametrize("of_groups", [False, True], ids=["agents", "groups"])
def test_actors_of_agents_and_of_groups(case, of_groups):
    make_env, group_map = MAPS[case]
    env = make_env()
    assert {group: list(agents) for group, agents in env.group_map.items()} == group_map
    owners = {a: g for g, agents in group_map.items() for a in ([g] if of_groups else agents)}
    loss = make_loss(env, owners)
    batch = collect(env, loss)
    old = {group: batch[group, "action_log_prob"].clone() for group in group_map}
    for name in loss.names:
        perturb(loss.actor_losses[name], size=0.05)
        loss.update_factor(batch, name)
    # the policy as it is now, on the actions that were taken: group by group, agent by agent
    expected = torch.zeros(batch.shape)
    for group, agents in group_map.items():
        for index, agent in enumerate(agents):
            actor = loss.actor_losses[group if of_groups else agent].actor_network
            entries = batch.select((group, "observation"))
            new = actor.get_dist(entries).log_prob(batch[group, "action"])
            expected += (new - old[group])[..., index]
    assert_close(batch["factor"].squeeze(-1), expected.exp().detach(), rtol=1e-3, atol=1e-4)
    assert (batch["factor"] - 1).abs().max() > 1e-3


@pytest.mark.parametrize("case", MAPS)
def test_every_actor_learns(case):
    make_env, group_map = MAPS[case]
    env = make_env()
    loss = make_loss(env, {agent: group for group, agents in group_map.items() for agent in agents})
    optimizers = {
        name: torch.optim.Adam(part.parameters(), 1e-3) for name, part in loss.actor_losses.items()
    }
    batch = loss.estimate_advantage(collect(env, loss)).reshape(-1)
    before = {name: parameters_of(part) for name, part in loss.actor_losses.items()}
    metrics = sequential_update(
        loss,
        batch,
        lambda data, keys: [data.select(*keys, strict=False)] * 2,
        lambda name, losses: descend(optimizers[name], losses),
    )
    assert metrics["factor_min"] < 1 < metrics["factor_max"]
    for name, part in loss.actor_losses.items():
        pairs = zip(before[name], parameters_of(part), strict=True)
        assert not any(torch.equal(then, now) for then, now in pairs), name


@pytest.mark.parametrize("case", ["one group", "group per agent"])
def test_recurrent_actors(case):
    """Those of test_recurrent.py, in groups of several agents and of one."""
    make_env, group_map = MAPS[case]
    env = make_env()
    states, actors = {}, {}
    for group, agents in group_map.items():
        features = env.observation_spec[group, "observation"].shape[-1]
        state = Unbounded((len(agents), 1, 8))
        states[group] = Composite(h=state, shape=(len(agents),))
        for agent in agents:
            memory = GRUModule(
                features,
                8,
                in_keys=[(group, "observation"), (group, "h")],
                out_keys=[(group, "memory"), ("next", group, "h")],
            )
            head = nn.Sequential(nn.Linear(8, 4), NormalParamExtractor())
            outputs = [(group, "loc"), (group, "scale")]
            actors[agent] = ProbabilisticActor(
                TensorDictSequential(memory, TensorDictModule(head, [(group, "memory")], outputs)),
                in_keys=dict(zip(("loc", "scale"), outputs, strict=True)),
                out_keys=[(group, "action")],
                distribution_class=TanhNormal,
                return_log_prob=True,
                log_prob_key=(group, "action_log_prob"),
            )
    loss = HAPPOLoss(actors, group_map=env.group_map)
    transforms = Compose(StepCounter(4), InitTracker(), TensorDictPrimer(states, expand_specs=True))
    batch = collect(TransformedEnv(env, transforms), loss)
    assert batch.shape == (6, FRAMES // 6)
    assert batch["is_init"][:, 4].all()
    for group in group_map:
        assert batch[group, "h"].any()
    for name in loss.names:  # no actor has moved: every ratio is 1
        loss.update_factor(batch, name)
        assert_close(batch["factor"], torch.ones(*batch.shape, 1), rtol=1e-3, atol=1e-3)
    perturb(loss.actor_losses[name], size=0.1)
    assert (loss.update_factor(batch, name)["factor"] - 1).abs().max() > 1e-2


def test_agents_of_the_environment_are_named_in_the_error():
    env = balance(MarlGroupMapType.ALL_IN_ONE_GROUP)
    with pytest.raises(ValueError, match=r"\['robot'\].*'agents'.*'agent_2'"):
        make_loss(env, {"robot": "agents"})
