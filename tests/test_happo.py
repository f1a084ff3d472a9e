"""HAPPOLoss against stock ClipPPOLoss, brute-force formulas in plain torch, and GAE by hand."""

from __future__ import annotations

import copy
import itertools
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torch.testing import assert_close
from torchrl.modules import (
    MaskedCategorical,
    PopArtValueNorm,
    ProbabilisticActor,
    RunningValueNorm,
    TanhNormal,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import ValueEstimators

from marl_explore.happo import HAPPOLoss

ARENAS, STEPS, ROBOTS = 6, 11, 4
FEATURES, ACTIONS = 5, 4
DRONE_FEATURES, DRONE_ACTIONS = 3, 2
CLIP = 0.2
GAMMA, LMBDA = 0.9, 0.8
NAMES = [f"robot_{i}" for i in range(ROBOTS)]
VIEWS = {name: ("agents", i) for i, name in enumerate(NAMES)}


@pytest.fixture(autouse=True)
def _same_random_numbers():
    torch.manual_seed(0)


# ------------------------------------------------------------------------ networks


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, outputs))


def ground_network() -> nn.Module:
    """Logits of a ground robot."""
    return mlp(FEATURES, ACTIONS)


def drone_network() -> nn.Module:
    """Location and scale of a drone's continuous action."""
    return nn.Sequential(mlp(DRONE_FEATURES, 2 * DRONE_ACTIONS), NormalParamExtractor())


def masked_actor(network: nn.Module, group: str) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, [(group, "observation")], [(group, "logits")]),
        in_keys={"logits": (group, "logits"), "mask": (group, "action_mask")},
        out_keys=[(group, "action")],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=(group, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def continuous_actor(network: nn.Module, group: str) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, [(group, "observation")], [(group, "loc"), (group, "scale")]),
        in_keys={"loc": (group, "loc"), "scale": (group, "scale")},
        out_keys=[(group, "action")],
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=(group, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def state_critic(value_key: str = "state_value") -> TensorDictModule:
    return TensorDictModule(mlp(FEATURES, 1), ["state"], [value_key])


def parameters_of(*modules: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for module in modules for p in module.parameters()]


def all_equal(first: Iterable[Tensor], second: Iterable[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def perturb(network: nn.Module, size: float = 0.3) -> None:
    """An update of unknown origin."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += size * torch.randn_like(parameter)


def total(losses: TensorDictBase) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def descend(optimizer: torch.optim.Optimizer, losses: TensorDictBase) -> None:
    optimizer.zero_grad()
    total(losses).backward()
    optimizer.step()


def assert_same_losses(first: TensorDictBase, second: TensorDictBase) -> None:
    assert set(first.keys()) == set(second.keys())
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


# ------------------------------------------------------------------------- batches


def random_mask(*shape: int) -> Tensor:
    mask = torch.rand(*shape, ACTIONS) < 0.6
    mask[..., 0] = True
    return mask


def rollout(**entries: Tensor | dict[str, Tensor]) -> TensorDict:
    """A batch [6, 11] of these entries, random states, rewards and ends of episodes."""
    shape = (ARENAS, STEPS)
    terminated = torch.rand(*shape, 1) < 0.1
    truncated = torch.rand(*shape, 1) < 0.1
    after = {
        "state": torch.randn(*shape, FEATURES),
        "reward": torch.randn(*shape, 1),
        "done": terminated | truncated,
        "terminated": terminated,
    }
    entries = {"state": torch.randn(*shape, FEATURES), **entries, "next": after}
    return TensorDict(entries, shape)


def with_advantage(batch: TensorDict) -> TensorDict:
    batch["advantage"] = torch.randn(*batch.shape, 1)
    batch["value_target"] = torch.randn(*batch.shape, 1)
    return batch


# ------------------------------------------------------------- brute-force formulas


def masked_log_prob(
    network: nn.Module, observation: Tensor, mask: Tensor, action: Tensor
) -> Tensor:
    logits = network(observation).masked_fill(~mask, -torch.inf)
    return logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)


def tanh_normal_log_prob(network: nn.Module, observation: Tensor, action: Tensor) -> Tensor:
    loc, scale = network(observation)
    return TransformedDistribution(Normal(loc, scale), TanhTransform()).log_prob(action).sum(-1)


def robot_ratio(new: nn.Module, old: nn.Module, batch: TensorDictBase, robot: int) -> Tensor:
    """Ratio [*B] of a robot's new to its old policy, its row of the group "agents" being given."""
    keys = ("observation", "action_mask", "action")
    row = [batch["agents", key].select(batch.ndim, robot) for key in keys]
    return (masked_log_prob(new, *row) - masked_log_prob(old, *row).detach()).exp()


def clipped_objective(ratio: Tensor, factor: Tensor, advantage: Tensor) -> Tensor:
    """The loss as the HAPPO paper has it, factor outside: -E[M min(r A, clip(r) A)]."""
    clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
    return -(factor * torch.min(ratio * advantage, clipped * advantage)).mean()


def gae_by_hand(
    values: list[float],
    next_values: list[float],
    rewards: list[float],
    dones: list[bool],
    terminations: list[bool],
) -> list[float]:
    """Advantages of one row of steps, some of which end an episode."""
    advantages = [0.0] * len(rewards)
    following = 0.0
    for t in reversed(range(len(rewards))):
        bootstrap = 0.0 if terminations[t] else next_values[t]
        error = rewards[t] + GAMMA * bootstrap - values[t]
        following = error + (0.0 if dones[t] else GAMMA * LMBDA * following)
        advantages[t] = following
    return advantages


# ------------------------------------------------------------ one robot is plain PPO


@pytest.mark.parametrize("continuous", [False, True], ids=["masked categorical", "TanhNormal"])
def test_one_robot_is_clip_ppo_bitwise(continuous):
    shape = (ARENAS, STEPS)
    if continuous:
        actor = continuous_actor(drone_network(), "agents")
        batch = rollout(agents={"observation": torch.randn(*shape, DRONE_FEATURES)})
    else:
        actor = masked_actor(ground_network(), "agents")
        entries = {"observation": torch.randn(*shape, FEATURES), "action_mask": random_mask(*shape)}
        batch = rollout(agents=entries)
    critic = state_critic()
    with torch.no_grad():
        actor(batch)
    stock_actor, stock_critic = copy.deepcopy(actor), copy.deepcopy(critic)

    happo = HAPPOLoss({"robot": actor}, critic, clip_epsilon=CLIP, entropy_coeff=0.01)
    happo.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    stock = ClipPPOLoss(
        stock_actor, stock_critic, clip_epsilon=CLIP, entropy_coeff=0.01, loss_critic_type="l2"
    )
    stock.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=True)

    stock_batch, functional_batch = batch.clone(), batch.clone()
    happo.estimate_advantage(batch)
    with torch.no_grad():
        stock.value_estimator(stock_batch)
        stock.value_estimator(
            functional_batch,
            params=stock.critic_network_params,
            target_params=stock.target_critic_network_params,
        )
    for key in ("advantage", "value_target", "state_value"):
        assert torch.equal(batch[key], stock_batch[key]), key
        # Stacked copies of the parameters make the matrix products round otherwise.
        assert_close(batch[key], functional_batch[key], rtol=0, atol=2e-6)

    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-2)
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=1e-2)
    stock_optimizer = torch.optim.Adam(stock.parameters(), lr=1e-2)
    flat, stock_flat = batch.reshape(-1), stock_batch.reshape(-1)
    for step in range(8):
        torch.manual_seed(step)  # TanhNormal's entropy is estimated from a sample
        expected = stock(stock_flat)
        torch.manual_seed(step)
        got = happo.actor_loss(flat, "robot")
        critic_got = happo.critic_loss(flat)

        shared = set(expected.keys()) - {"loss_critic", "explained_variance"}
        assert shared == set(got.keys())
        for key in shared:
            assert torch.equal(got[key], expected[key]), (step, key)
        assert torch.equal(critic_got["loss_critic"], expected["loss_critic"]), step
        # The stock loss guards its division by another epsilon, and keeps the last axis.
        assert_close(critic_got["explained_variance"], expected["explained_variance"].squeeze())

        descend(stock_optimizer, expected)
        descend(optimizer, got)
        descend(critic_optimizer, critic_got)
        assert all_equal(actor.parameters(), stock_actor.parameters()), step
        assert all_equal(critic.parameters(), stock_critic.parameters()), step
    assert expected["clip_fraction"] > 0.05  # the clip had something to do


# ---------------------------------------------------- four robots of a stacked group


@dataclass
class Team:
    """Four robots with views of the group "agents", a critic of the joint observation, a batch."""

    networks: list[nn.Module]
    critic: TensorDictModule
    loss: HAPPOLoss
    batch: TensorDict  # [6, 11], with random advantages and value targets

    @property
    def modules(self) -> list[nn.Module]:
        return [*self.networks, self.critic]


def make_team(value_key: str = "state_value", **options) -> Team:
    networks = [ground_network() for _ in NAMES]
    critic = TensorDictModule(
        nn.Sequential(nn.Flatten(-2), mlp(ROBOTS * FEATURES, 1)),
        [("agents", "observation")],
        [value_key],
    )
    actors = {n: masked_actor(net, "agents") for n, net in zip(NAMES, networks, strict=True)}
    loss = HAPPOLoss(actors, critic, views=VIEWS, clip_epsilon=CLIP, **options)

    shape = (ARENAS, STEPS, ROBOTS)
    observation, mask = torch.randn(*shape, FEATURES), random_mask(*shape)
    rows = zip(networks, observation.unbind(-2), strict=True)
    with torch.no_grad():
        logits = torch.stack([network(own) for network, own in rows], -2)
    policy = torch.distributions.Categorical(logits=logits.masked_fill(~mask, -torch.inf))
    action = policy.sample()
    agents = {
        "observation": observation,
        "action_mask": mask,
        "action": action,
        "action_log_prob": policy.log_prob(action),
    }
    batch = with_advantage(rollout(agents=agents))
    batch["next", "agents"] = {"observation": torch.randn(*shape, FEATURES)}
    return Team(networks, critic, loss, batch)


@pytest.mark.parametrize("minibatch_size", [ARENAS * STEPS, 22], ids=["full batch", "minibatches"])
def test_sequential_updates_match_brute_force(minibatch_size):
    team = make_team()
    old = copy.deepcopy(team.networks)
    flat = team.batch.reshape(-1)
    advantage = flat["advantage"].squeeze(-1)
    factor = torch.ones(len(flat))
    left_the_clip = False

    for robot in (2, 0, 3, 1):
        network, name = team.networks[robot], NAMES[robot]
        parameters = list(network.parameters())
        optimizer = torch.optim.Adam(parameters, lr=3e-2)
        for _ in range(4):
            for index in torch.randperm(len(flat)).split(minibatch_size):
                minibatch = flat[index]
                losses = team.loss.actor_loss(minibatch, name)
                ratio = robot_ratio(network, old[robot], minibatch, robot)
                expected = clipped_objective(ratio, factor[index], advantage[index])
                assert_close(losses["loss_objective"], expected)
                gradient = torch.autograd.grad(
                    losses["loss_objective"], parameters, retain_graph=True
                )
                assert_close(gradient, torch.autograd.grad(expected, parameters))
                outside = ((ratio - 1).abs() > CLIP).float().mean()
                assert_close(losses["clip_fraction"], outside)
                left_the_clip |= bool(outside)
                descend(optimizer, losses)
        team.loss.update_factor(flat, name)
        with torch.no_grad():
            factor = factor * robot_ratio(network, old[robot], flat, robot)
        assert_close(flat["factor"].squeeze(-1), factor)
    assert left_the_clip


def test_absent_factor_is_a_factor_of_ones():
    team = make_team()
    perturb(team.networks[1])
    absent = team.loss.actor_loss(team.batch, "robot_1")
    team.batch["factor"] = torch.ones_like(team.batch["advantage"])
    ones = team.loss.actor_loss(team.batch, "robot_1")
    assert_same_losses(absent, ones)


@pytest.mark.parametrize("robot", range(ROBOTS))
def test_an_actor_update_moves_no_other_parameters(robot):
    team = make_team()
    # one optimizer over everything: a gradient that leaked would move others
    optimizer = torch.optim.Adam(team.loss.parameters(), lr=1e-2)
    before = [parameters_of(module) for module in team.modules]
    for _ in range(3):
        descend(optimizer, team.loss.actor_loss(team.batch, NAMES[robot]))
        team.loss.update_factor(team.batch, NAMES[robot])
    for i, module in enumerate(team.modules):
        assert all_equal(before[i], module.parameters()) == (i != robot), i
        assert all((p.grad is None) == (i != robot) for p in module.parameters()), i


def test_a_critic_update_moves_no_actor():
    team = make_team()
    optimizer = torch.optim.Adam(team.loss.parameters(), lr=1e-2)
    before = parameters_of(*team.networks), parameters_of(team.critic)
    descend(optimizer, team.loss.critic_loss(team.batch))
    assert all_equal(before[0], parameters_of(*team.networks))
    assert not all_equal(before[1], team.critic.parameters())


def test_losses_leave_the_batch_alone():
    team = make_team()
    team.batch["factor"] = torch.rand_like(team.batch["advantage"])
    before = team.batch.clone()
    team.loss.actor_loss(team.batch, "robot_3")
    team.loss.critic_loss(team.batch)
    team.loss(team.batch)
    assert set(team.batch.keys(True, True)) == set(before.keys(True, True))
    assert (team.batch == before).all()


# ----------------------------------------------------------------- the factor alone


def test_factor_is_neither_clipped_nor_normalised_nor_differentiated():
    team = make_team()
    old = copy.deepcopy(team.networks)
    for network in team.networks:
        perturb(network)
    expected = torch.ones(ARENAS, STEPS)
    with torch.enable_grad():
        for i, name in enumerate(NAMES):
            assert team.loss.update_factor(team.batch, name) is team.batch
            expected = expected * robot_ratio(team.networks[i], old[i], team.batch, i).detach()
    factor = team.batch["factor"]
    assert factor.shape == (ARENAS, STEPS, 1)
    assert_close(factor.squeeze(-1), expected)
    assert factor.min() < (1 - CLIP) ** ROBOTS
    assert factor.max() > (1 + CLIP) ** ROBOTS
    assert not factor.requires_grad
    assert all(p.grad is None for p in team.loss.parameters())


def test_factor_over_rollouts_and_flat_batches_alike():
    team = make_team()
    for network in team.networks:
        perturb(network)
    flat, single = team.batch.reshape(-1), team.batch[0, 0]
    for name in NAMES:
        for batch in (team.batch, flat, single):
            team.loss.update_factor(batch, name)
    assert flat["factor"].shape == (ARENAS * STEPS, 1)
    assert_close(team.batch["factor"].reshape(-1, 1), flat["factor"])
    assert_close(team.batch["factor"][0, 0], single["factor"])


def test_entropy_bonus_is_not_weighted_by_the_factor():
    team = make_team(entropy_coeff=0.05)
    group = team.batch["agents"]
    without = team.loss.actor_loss(team.batch, "robot_0")
    team.batch["factor"] = 0.1 + 3 * torch.rand(ARENAS, STEPS, 1)
    losses = team.loss.actor_loss(team.batch, "robot_0")
    assert not torch.equal(losses["loss_objective"], without["loss_objective"])
    assert torch.equal(losses["loss_entropy"], without["loss_entropy"])

    logits = team.networks[0](group["observation"][:, :, 0])
    probability = logits.masked_fill(~group["action_mask"][:, :, 0], -torch.inf).softmax(-1)
    entropy = -torch.special.xlogy(probability, probability).sum(-1).mean()
    assert_close(losses["entropy"], entropy)
    assert_close(losses["loss_entropy"], -0.05 * entropy)


# ----------------------------------------------------------------- order of updates


def test_update_order_takes_every_permutation_equally_often():
    loss = make_team().loss
    generator = torch.Generator().manual_seed(5)
    draws, permutations = 4800, list(itertools.permutations(NAMES))
    count = Counter(tuple(loss.update_order(generator)) for _ in range(draws))
    assert set(count) == set(permutations)
    expected = draws / len(permutations)
    assert all(abs(n - expected) < 5 * expected**0.5 for n in count.values()), count
    first = Counter()
    for order, n in count.items():
        first[order[0]] += n
    assert all(abs(n - draws / ROBOTS) < 5 * (draws / ROBOTS) ** 0.5 for n in first.values()), first


def test_update_order_depends_on_the_generator_only():
    loss = make_team().loss

    def orders(global_seed: int) -> list[list[str]]:
        torch.manual_seed(global_seed)
        generator = torch.Generator().manual_seed(7)
        state = torch.get_rng_state()
        drawn = [loss.update_order(generator) for _ in range(20)]
        assert torch.equal(state, torch.get_rng_state())
        return drawn

    assert orders(1) == orders(2)


# ------------------------------------------------- groups with other action spaces


@dataclass
class MixedTeam:
    """A masked ground robot, and a pair of continuous drones that share one actor."""

    ground: nn.Module
    drone: nn.Module
    loss: HAPPOLoss
    batch: TensorDict  # [6, 11], with random advantages and value targets

    def ratio(self, name: str, old: nn.Module, batch: TensorDictBase) -> Tensor:
        """Ratio [*B] of an actor; of the pair it is that of the joint action of both drones."""
        if name == "drones":
            return self.drone_ratios(old, batch).prod(-1)
        row = [batch[name][key] for key in ("observation", "action_mask", "action")]
        return (masked_log_prob(self.ground, *row) - masked_log_prob(old, *row).detach()).exp()

    def drone_ratios(self, old: nn.Module, batch: TensorDictBase) -> Tensor:
        """Ratio [*B, 2] of each drone's own action."""
        row = [batch["drones"][key] for key in ("observation", "action")]
        change = tanh_normal_log_prob(self.drone, *row) - tanh_normal_log_prob(old, *row).detach()
        return change.exp()


def make_mixed_team() -> MixedTeam:
    ground, drone = ground_network(), drone_network()
    actors = {
        "ground": masked_actor(ground, "ground"),
        "drones": continuous_actor(drone, "drones"),
    }
    shape = (ARENAS, STEPS)
    entries = {"observation": torch.randn(*shape, FEATURES), "action_mask": random_mask(*shape)}
    drones = {"observation": torch.randn(*shape, 2, DRONE_FEATURES)}
    batch = with_advantage(rollout(ground=entries, drones=drones))
    with torch.no_grad():
        for actor in actors.values():
            actor(batch)
    loss = HAPPOLoss(actors, state_critic(), clip_epsilon=CLIP)
    return MixedTeam(ground, drone, loss, batch)


@pytest.mark.parametrize("order", [("ground", "drones"), ("drones", "ground")])
@pytest.mark.parametrize("flat", [False, True], ids=["rollout", "flat"])
def test_mixed_groups_factor_matches_brute_force(order, flat):
    team = make_mixed_team()
    old = {"ground": copy.deepcopy(team.ground), "drones": copy.deepcopy(team.drone)}
    batch = team.batch.reshape(-1) if flat else team.batch
    expected = torch.ones(batch.shape)
    for name in order:
        perturb(team.ground if name == "ground" else team.drone, size=0.1)
        team.loss.update_factor(batch, name)
        expected = expected * team.ratio(name, old[name], batch).detach()
        assert_close(batch["factor"].squeeze(-1), expected, rtol=1e-4, atol=1e-5)


def test_mixed_groups_ground_robot_loss_after_the_drones():
    team = make_mixed_team()
    old_ground, old_drone = copy.deepcopy(team.ground), copy.deepcopy(team.drone)
    perturb(team.ground)
    perturb(team.drone, size=0.1)
    team.loss.update_factor(team.batch, "drones")
    got = team.loss.actor_loss(team.batch, "ground")["loss_objective"]
    expected = clipped_objective(
        team.ratio("ground", old_ground, team.batch),
        team.ratio("drones", old_drone, team.batch).detach(),
        team.batch["advantage"].squeeze(-1),
    )
    assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_mixed_groups_each_drone_of_a_shared_actor_is_clipped_on_its_own():
    team = make_mixed_team()
    old_ground, old_drone = copy.deepcopy(team.ground), copy.deepcopy(team.drone)
    perturb(team.ground)
    perturb(team.drone, size=0.1)
    team.loss.update_factor(team.batch, "ground")
    got = team.loss.actor_loss(team.batch, "drones")["loss_objective"]
    expected = clipped_objective(
        team.drone_ratios(old_drone, team.batch),
        team.ratio("ground", old_ground, team.batch).detach().unsqueeze(-1),
        team.batch["advantage"],
    )
    assert_close(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda actor, critic: HAPPOLoss({}, critic), "at least one actor"),
        (
            lambda actor, critic: HAPPOLoss({"a": actor}, views={"a": ("team", 0)}),
            "views\\['a'\\].*'team'.*reads",
        ),
        (
            lambda actor, critic: HAPPOLoss({"a": actor}, continuous_actor(critic, "ground")),
            "'a' and 'critic' share parameters",
        ),
    ],
    ids=["no actors", "view of another group", "critic in an actor"],
)
def test_parts_that_do_not_fit_are_refused(build, message):
    network = ground_network()
    with pytest.raises(ValueError, match=message):
        build(masked_actor(network, "ground"), network)


def test_padded_batches_are_refused():
    team = make_mixed_team()
    padded = team.batch.set(("collector", "mask"), torch.ones(*team.batch.shape, dtype=torch.bool))
    with pytest.raises(ValueError, match="split_trajs=False"):
        team.loss.estimate_advantage(padded)


# --------------------------------------------------------------------- action masks


def test_masked_actions_have_no_probability_and_no_gradient():
    samples = 40
    mask = random_mask(samples)
    table = nn.Linear(samples, ACTIONS, bias=False)  # column s holds the logits of sample s
    actor = masked_actor(table, "robot")
    entries = {"observation": torch.eye(samples), "action_mask": mask}
    batch = TensorDict({"robot": entries}, [samples])
    with torch.no_grad():
        actor(batch)
    perturb(table)
    batch["advantage"] = torch.randn(samples, 1)
    batch["factor"] = 0.5 + torch.rand(samples, 1)

    distribution = actor.get_dist(batch)
    for action in range(ACTIONS):
        log_prob = distribution.log_prob(torch.full((samples,), action))
        assert torch.equal(log_prob == -torch.inf, ~mask[:, action])

    loss = HAPPOLoss({"robot": actor}, entropy_coeff=0.05)
    for key in ("loss_objective", "loss_entropy"):
        (gradient,) = torch.autograd.grad(loss.actor_loss(batch, "robot")[key], [table.weight])
        assert gradient.isfinite().all()
        assert (gradient.T[~mask] == 0).all()
        assert (gradient.T[mask] != 0).any()


# ------------------------------------------------------------------ value estimation


def episodes() -> TensorDict:
    """Two rows of eight steps. Row 0: terminated at 2, truncated at 5. Row 1: both the other way.

    Next observations continue within an episode; where one ends, they differ from the first
    observation of the next episode. Both rows go on at the end of the batch.
    """
    rows, steps = 2, 8
    terminated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    truncated = torch.zeros_like(terminated)
    terminated[0, 2] = truncated[0, 5] = truncated[1, 3] = terminated[1, 6] = True
    done = terminated | truncated
    state = torch.randn(rows, steps, FEATURES)
    following = torch.cat([state[:, 1:], torch.randn(rows, 1, FEATURES)], 1)
    after = {
        "state": torch.where(done, torch.randn_like(following), following),
        "reward": torch.randn(rows, steps, 1),
        "done": done,
        "terminated": terminated,
    }
    return TensorDict({"state": state, "next": after}, [rows, steps])


def advantages_by_hand(batch: TensorDictBase, value: Tensor, next_value: Tensor) -> Tensor:
    ends = batch["next"]
    columns = (value, next_value, ends["reward"], ends["done"], ends["terminated"])
    rows = zip(*(column.squeeze(-1).tolist() for column in columns), strict=True)
    return torch.tensor([gae_by_hand(*row) for row in rows]).unsqueeze(-1)


def predictions(critic: TensorDictModule, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
    """The critic's outputs for the observations and the next observations."""
    with torch.no_grad():
        return critic.module(batch["state"]), critic.module(batch["next", "state"])


def loss_of_critic(critic: TensorDictModule, **options) -> HAPPOLoss:
    return HAPPOLoss({"robot": masked_actor(ground_network(), "robot")}, critic, **options)


def test_truncated_episodes_bootstrap_and_terminated_ones_do_not():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    value, next_value = predictions(critic, batch)
    expected = advantages_by_hand(batch, value, next_value)
    assert loss.estimate_advantage(batch) is batch
    assert_close(batch["advantage"], expected)
    assert_close(batch["value_target"], expected + value)
    assert_close(batch["state_value"], value)
    assert not any(batch[key].requires_grad for key in ("advantage", "value_target"))


def test_average_gae_is_the_default_and_normalises_over_the_batch():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    loss.estimate_advantage(batch)
    advantage = batch["advantage"]
    assert_close(advantage.mean(), torch.tensor(0.0))
    assert_close(advantage.std(), torch.tensor(1.0))
    value, next_value = predictions(critic, batch)
    raw = advantages_by_hand(batch, value, next_value)
    assert_close(advantage, (raw - raw.mean()) / raw.std())
    assert_close(batch["value_target"], raw + value)  # the critic's target is not normalised


def test_an_estimate_uses_the_critic_as_it_is_now():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    loss.estimate_advantage(batch)
    perturb(critic)
    loss.estimate_advantage(batch)
    assert_close(batch["advantage"], advantages_by_hand(batch, *predictions(critic, batch)))


def test_default_estimator_has_the_documented_numbers():
    critic, batch = state_critic(), episodes()
    explicit = batch.clone()
    loss_of_critic(critic).estimate_advantage(batch)
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95, average_gae=True)
    assert torch.equal(batch["advantage"], loss.estimate_advantage(explicit)["advantage"])


EARLIER = torch.tensor([[10.0], [14.0], [15.0], [21.0]])  # targets seen before: mean 15, var 15.5


@pytest.mark.parametrize("norm_class", [RunningValueNorm, PopArtValueNorm])
def test_gae_uses_denormalised_values(norm_class):
    critic, batch = state_critic(), episodes()
    norm = norm_class()
    norm.update(EARLIER)
    loss = loss_of_critic(critic, value_norm=norm)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    value, next_value = (15 + 15.5**0.5 * v for v in predictions(critic, batch))
    expected = advantages_by_hand(batch, value, next_value)
    loss.estimate_advantage(batch)
    tolerance = {"rtol": 1e-4, "atol": 1e-3 if norm_class is PopArtValueNorm else 1e-5}
    assert_close(batch["state_value"], value, **tolerance)
    assert_close(batch["advantage"], expected, **tolerance)
    assert_close(batch["value_target"], expected + value, **tolerance)


def test_critic_loss_is_a_squared_error_in_normalised_units():
    critic, batch = state_critic(), episodes()
    norm = RunningValueNorm()
    norm.update(EARLIER)
    loss = loss_of_critic(critic, value_norm=norm)
    loss.estimate_advantage(batch)
    seen = torch.cat([EARLIER, batch["value_target"].reshape(-1, 1)])
    target = (batch["value_target"] - seen.mean()) / seen.std(correction=0)
    value, _ = predictions(critic, batch)
    losses = loss.critic_loss(batch)
    assert_close(losses["loss_critic"], ((value - target) ** 2).mean())  # no factor 1/2
    explained = 1 - (target - value).var(correction=0) / target.var(correction=0)
    assert_close(losses["explained_variance"], explained)


def test_critic_loss_without_normalisation():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.estimate_advantage(batch)
    value, _ = predictions(critic, batch)
    expected = ((value - batch["value_target"]) ** 2).mean()
    assert_close(loss.critic_loss(batch)["loss_critic"], expected)


def test_value_statistics_are_updated_once_per_estimate():
    critic, batch = state_critic(), episodes()
    norm = RunningValueNorm()
    loss = loss_of_critic(critic, value_norm=norm)
    seen = []
    for _ in range(2):
        loss.estimate_advantage(batch)
        seen.append(batch["value_target"].reshape(-1))
        targets = torch.cat(seen)
        for _ in range(3):
            loss.critic_loss(batch)
            loss.critic_loss(batch.reshape(-1)[:5])
        assert norm.count == len(targets)
        assert_close(norm.mean, targets.mean().view(1))
        assert_close(norm.m2 / norm.count, targets.var(correction=0).view(1))


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
