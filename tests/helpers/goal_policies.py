"""Policies that choose among goals, with drawn weights."""

from __future__ import annotations

import torch

from marl_explore import ArenaConfig, Goals, Policy, PolicyConfig


def goal_policy(
    num_agents=4, seed=0, shared=True, prior=1.0, strength=1.0, reads_sensor=False, **options
):
    """A policy as if trained: far from its prior, so that choices vary."""
    torch.manual_seed(seed)
    arena = ArenaConfig(num_agents=num_agents, **options)
    config = PolicyConfig(arena, Goals(prior=prior, reads_sensor=reads_sensor), shared=shared)
    policy = Policy(config, config.make_actors())
    for name, parameter in policy.named_parameters():
        if name.endswith(("weight", "bias")):
            parameter.data *= 1 + strength * torch.randn_like(parameter)
            parameter.data += strength * torch.randn_like(parameter) / 8
    return policy
