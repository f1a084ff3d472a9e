"""Policies that act on what their robot observes."""

import random

import numpy as np

made = []
"""Numbers and seeds of the robots for which an object was made."""


def walk(observation):
    """A random allowed action."""
    return random.choice(np.flatnonzero(observation.action_mask).tolist())


class Greedy:
    """To the nearest frontiers by its table, or anywhere; communicates where that is new."""

    sees = "its frontier table"
    fpr = None

    def __init__(self, robot, config, seed):
        self.robot, self.config = robot, config
        self.chance = np.random.default_rng(seed)
        made.append((robot, seed))

    def __call__(self, observation):
        if any(observation.steps_since_merge[mate] > 5 for mate in observation.mates):
            return 9
        number, mean, _ = observation.fpr.T
        wanted = np.where(number > 0, mean, np.inf).argmin()
        if number.any() and observation.action_mask[wanted] and not observation.refused:
            return wanted
        return self.chance.choice(np.flatnonzero(observation.action_mask[:9]))


class Vandal:
    """Overwrites what it gets, and does nothing else."""

    def __call__(self, observation):
        for entry in (observation.map, observation.fov, observation.net, observation.unshared):
            entry[...] = 1
        observation.mates.clear()
        return 8


seen = []


def trained_on_agents(observation):
    """As written for an agent of a PettingZoo environment."""
    seen.append({name: entry.copy() for name, entry in observation.items()})
    allowed = np.flatnonzero(observation["action_mask"])
    return allowed[int(observation["observation"].sum()) % len(allowed)]


trained_on_agents.observes = "pettingzoo"


def wrong(observation):
    """No action."""
    return 3.5 if observation.step == 2 else 8


class NeedsMore:
    def __init__(self, robot, weights):
        self.weights = weights


class Mute:
    """Cannot be called."""


def blurred(observation):
    return 8


blurred.fpr = "blurred"
number = 3
