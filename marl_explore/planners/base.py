"""The base class of planners: the entries that they read, and the yield rule."""

from __future__ import annotations

from abc import abstractmethod

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.grid import COMMUNICATE
from marl_explore.core.motion import give_way
from marl_explore.core.ways import make_room
from marl_explore.planners.communication import CommunicationRule
from marl_explore.planners.hindrances import Hindrances


class Planner(TensorDictModuleBase):
    """Chooses a move by ``plan``, unless its communication rule says to communicate.

    A robot whose last move was refused, or whose planned move is not allowed, makes a random
    allowed move instead. Without this yield rule two robots that want to pass each other would
    block each other. In wider worlds plans lead around what blocks the way but is on no map, robots
    whose messages get lost go on alone, and refusals wait for the next turn (``Hindrances``).

    Args:
        communicate: when a robot communicates.
        config: the arena, for what a wider world needs; None: the paper's world.
    """

    in_keys: list[NestedKey] = [  # noqa: RUF012 - TensorDict modules declare their keys like this
        "step_count",
        *(
            ("agents", key)
            for key in (
                "map",
                "position",
                "action_mask",
                "dangerous",
                "merged",
                "steps_since_merge",
                "unshared",
                "linked",
            )
        ),
        ("agents", "observation", "fov"),
    ]
    out_keys: list[NestedKey] = [("agents", "action")]  # noqa: RUF012

    sees: str = "own map, positions of robots in range"
    """The information that a robot's decisions use, as text."""
    reference: bool = False
    """Whether it uses information that no robot has: it is for comparison only."""
    shares_maps: bool = False
    """Whether it is measured as if all maps were shared at no cost."""

    def __init__(self, communicate: CommunicationRule, config: ArenaConfig | None = None) -> None:
        super().__init__()
        self.communicate = communicate
        self._hindrances = Hindrances(config)

    def only(self, arenas: Tensor) -> None:
        """Forget all but some arenas of the batch [B], int64 [b]: the next one has only those."""
        self._hindrances.only(arenas)

    @abstractmethod
    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """The wanted action of each robot: a move, STAY or COMMUNICATE, int64 [*B, N]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action")."""
        seen = self._hindrances.seen(tensordict)
        refused = self._hindrances.refused(tensordict)
        crowded = self._hindrances.crowded(tensordict)
        mask = seen.get(("agents", "action_mask"))
        grid, position = (tensordict.get(("agents", key)) for key in ("map", "position"))
        wanted = make_room(self.plan(seen), crowded, grid, position)
        action = give_way(wanted, mask, refused, crowded)
        action = action.masked_fill(self.communicate(seen), COMMUNICATE)
        self._hindrances.note(action)
        return tensordict.set(("agents", "action"), action)
