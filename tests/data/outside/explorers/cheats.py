"""Policies that act on what their robot cannot know, each in its own way."""

import inspect

import numpy as np
import torch


def _some(mask, number):
    allowed = np.flatnonzero(mask)
    return allowed[number % len(allowed)]


class Telepath:
    """All robots share their maps."""

    maps = {}  # noqa: RUF012 - that is the cheat

    def __init__(self, robot):
        self.robot = robot

    def __call__(self, observation):
        self.maps[self.robot] = observation.map
        known = sum(int((grid != -1).sum()) for grid in self.maps.values())
        return _some(observation.action_mask, known)


def peeps(observation):
    """Looks for the environment among the variables of its callers."""
    callers = (frame.frame.f_locals.values() for frame in inspect.stack(context=0))
    env = next(x for held in callers for x in held if type(x).__name__ == "ExplorationEnv")
    return _some(observation.action_mask, int(env._now.world.obstacles.sum()))


def unseeded(observation):
    return np.random.default_rng().choice(np.flatnonzero(observation.action_mask))


def _chosen(td, number):
    """The allowed action of every robot with a number."""
    mask = td["agents", "action_mask"]
    order = (torch.arange(10) + number.unsqueeze(-1)) % 10
    first = mask.gather(-1, order).int().argmax(-1, keepdim=True)
    return td.set(("agents", "action"), order.gather(-1, first).squeeze(-1))


def _by_root(key):
    def policy(td):
        number = td[key].flatten(1).sum(-1, keepdim=True).long()
        return _chosen(td, number.expand(td["agents", "alive"].shape))

    policy.for_team = True
    return policy


def _by_mean_of_team(key):
    def policy(td):
        entry = td["agents", key].long()
        entry = entry.view(*entry.shape[:2], -1).sum(-1)
        return _chosen(td, entry.sum(-1, keepdim=True).expand_as(entry))

    policy.for_team = True
    return policy


obstacles, walkers, draw_key = map(_by_root, ("obstacles", "walkers", "draw_key"))
maps, positions, links, failures, masks = map(
    _by_mean_of_team, ("map", "position", "linked", "alive", "action_mask")
)


def late(observation):
    """Honest for some steps."""
    return peeps(observation) if observation.step > 6 else 8


class ByRow:
    """Honest: by what its robot may know of the team."""

    for_team = True

    def __call__(self, td):
        agents = td["agents"]
        robots = torch.arange(agents["alive"].shape[-1])
        near = (agents["position"].unsqueeze(1) * agents["linked"].unsqueeze(-1)).sum((-1, -2))
        return _chosen(td, near + agents["unshared"].sum(-1) + robots)
