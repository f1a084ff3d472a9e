"""The exploration task, and HAPPO, for BenchMARL: a task that plugs in from here, an algorithm.

BenchMARL 1.5.2 asks for an older TorchRL: install it with ``pip install --no-deps benchmarl``. Two
lines below give it back what changed: a class's name, and that a check of shapes is optional. So
this package must be imported before ``benchmarl``.
"""

from __future__ import annotations

from functools import partial

import torchrl.collectors
from torchrl.modules import QValueModule

torchrl.collectors.SyncDataCollector = torchrl.collectors.Collector  # its name until TorchRL 0.11

from benchmarl.algorithms import iql, qmix, vdn  # noqa: E402

# they hand it a spec without its group, which its new check takes for another shape
iql.QValueModule = vdn.QValueModule = qmix.QValueModule = partial(QValueModule, strict_shape=False)

from marl_explore.adapters.benchmarl.happo import Happo, HappoConfig  # noqa: E402
from marl_explore.adapters.benchmarl.task import ExplorationTask  # noqa: E402

__all__ = ["ExplorationTask", "Happo", "HappoConfig"]
