"""The exploration task as a BenchMARL task, and HAPPO as a BenchMARL algorithm.

BenchMARL 1.5.2 requires an older TorchRL: install it with ``pip install --no-deps benchmarl``. Two
lines below restore what has changed since: the name of a class, and that a shape check is optional.
Therefore this package must be imported before ``benchmarl``.
"""

from __future__ import annotations

from functools import partial

import torchrl.collectors
from torchrl.modules import QValueModule

from marl_explore.utils.extras import require_extra

require_extra("benchmarl")

torchrl.collectors.SyncDataCollector = torchrl.collectors.Collector  # its name up to TorchRL 0.11

from benchmarl.algorithms import iql, qmix, vdn  # noqa: E402

# they pass a spec without its group, which the new check rejects as another shape
iql.QValueModule = vdn.QValueModule = qmix.QValueModule = partial(QValueModule, strict_shape=False)

from marl_explore.adapters.benchmarl.happo import Happo, HappoConfig  # noqa: E402
from marl_explore.adapters.benchmarl.task import ExplorationTask  # noqa: E402

__all__ = ["ExplorationTask", "Happo", "HappoConfig"]
