"""The devices that torch computes on."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager

import torch

from marl_explore.config.checks import require

CPU = torch.device("cpu")
_NAMES = re.compile(r"cpu|cuda(:\d{1,3})?")


def find_device(name: str) -> torch.device:
    """The device with a name: "cpu", "cuda", "cuda:1", ...

    Raises:
        ValueError: for another name, or a device that torch does not find.
    """
    known = _NAMES.fullmatch(name)
    require(known is not None, "device", name, "it must be cpu, cuda, or cuda:1, ...")
    if name != "cpu":
        number = torch.cuda.device_count()
        wanted = int(name.partition(":")[2] or 0)  # torch's own index overflows
        require(wanted < number, "device", name, f"torch finds {number} CUDA devices here")
    return torch.device(name)


def keep_random_state(device: torch.device) -> AbstractContextManager[None]:
    """A context after which all of torch's generators are as before; a seed is that of all."""
    in_use = device.type == "cuda" or torch.cuda.is_initialized()
    return torch.random.fork_rng(devices=range(torch.cuda.device_count()) if in_use else ())
