"""Policies that act for whole teams."""

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase


def first_allowed(mask):
    return mask.int().argmax(-1)


first = TensorDictModule(first_allowed, [("agents", "action_mask")], [("agents", "action")])


class Counting(TensorDictModuleBase):
    """Remembers how often it was asked."""

    in_keys = (("agents", "action_mask"),)
    out_keys = (("agents", "action"),)
    sees = "which actions are allowed"

    def __init__(self, config):
        super().__init__()
        self.robots, self.asked = config.num_agents, 0

    def forward(self, td):
        self.asked += 1
        mask = td["agents", "action_mask"]
        order = (torch.arange(10) + self.asked) % 10
        return td.set(("agents", "action"), order[mask[..., order].int().argmax(-1)])


def staying(td):
    """A plain function, marked to act for teams."""
    return td.set(("agents", "action"), torch.full_like(td["agents", "alive"], 8, dtype=torch.int))


staying.for_team = True


def forgetful(td):
    return td


forgetful.for_team = True


def wordless(td):
    return None


wordless.for_team = True
