"""Export of policies for use without torch: one .npz for numpy, or an ONNX graph per robot.

Both hold only the actors' networks: FPR, NET and candidate goals are computed before the network,
and the choice comes after it (``marl_explore.robot`` does both; see docs/robots.md).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import NUM_ACTIONS, NUM_DIRECTIONS, NUM_FEATURES
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.policies.goal_graph import GoalGraph
from marl_explore.policies.io import require_weights
from marl_explore.policies.networks import PAPER_INPUTS
from marl_explore.policies.networks.goals import GoalActor
from marl_explore.policies.observations import robot_observation as robot_observation
from marl_explore.policies.policy import Policy
from marl_explore.robot.policy import FORMAT, save_arrays
from marl_explore.transforms.goals import Candidates, find_candidates
from marl_explore.transforms.memory import RememberTeam
from marl_explore.utils.extras import require_extra
from marl_explore.utils.files import atomic_write

Kind = Literal["npz", "onnx"]
"""Formats of exported policies."""
INPUTS = ("fov", "fpr", "net", "action_mask")
OUTPUTS = ("action", "masked_logits")
GOAL_INPUTS = Candidates._fields
GOAL_OUTPUTS = ("choice", "masked_logits")
"""Names in ONNX files of actors that choose among goals."""
_TO_SAMPLE = "; to sample, use masked_logits as the logits of a categorical distribution."
NOT_IN_THE_GRAPH = (
    "fov, fpr and net are computed before the network, fpr with the normalisation in the spec. "
    f"action is the most likely allowed one{_TO_SAMPLE}"
)
"""What users of an ONNX file need to know."""
GOALS_NOT_IN_THE_GRAPH = (
    "Memory and candidates (docs/goals.md) are computed before the network, in any arena and, if "
    "the actors are shared, any team; the first move to the choice and the yield rule come after "
    "it. Choices are the 24 frontiers, the teammates, to communicate and to stay; choice is the "
    f"most likely one{_TO_SAMPLE}"
)


class Deployed(nn.Module):
    """One robot's actor with its masked choice: the graph that is exported.

    Args:
        actor: the network.
    """

    def __init__(self, actor: nn.Module) -> None:
        super().__init__()
        self.actor = actor

    def forward(
        self, fov: Tensor, fpr: Tensor, net: Tensor, action_mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The most likely allowed action int64 [B], and logits [B, 10], -inf where not allowed.

        Args:
            fov: float32 [B, 2k + 1, 2k + 1].
            fpr: float32 [B, 8, 3].
            net: float32 [B, N].
            action_mask: bool [B, 10].
        """
        logits = self.actor(fov, fpr, net).masked_fill(~action_mask, -torch.inf)
        return logits.argmax(-1), logits


def spec_text(policy: Policy) -> str:
    """A description of the networks as JSON: format, arena, network, FPR's normalisation.

    Raises:
        ValueError: for actors that read more than robots compute: FOV, FPR and NET, or candidate
            goals.
    """
    read = policy.team.stacked.inputs
    if read not in (PAPER_INPUTS, Candidates._fields):
        raise ValueError(f"actors that read {read} cannot be exported: robots have {PAPER_INPUTS}")
    twin = policy.config.network.exported_as
    return json.dumps({"format": FORMAT, "twin": twin, **policy.config.to_json()})


def require_exportable(policy: Policy, kinds: Sequence[str]) -> None:
    """Raise an error for a policy that cannot be written in all of these formats.

    Args:
        policy: the team.
        kinds: "npz", "onnx" or both.

    Raises:
        ModuleNotFoundError: when ONNX is asked for and not installed, saying how to install it.
        ValueError: for actors that read more than robots compute, weights that are not finite, and,
            as .npz, a network without a numpy twin.
    """
    spec_text(policy)
    require_weights(policy.actors.state_dict(), "the policy")
    name = policy.config.network.name
    if "npz" in kinds and policy.config.network.exported_as is None:
        raise ValueError(f"{name} actors cannot be exported as .npz: they have no numpy twin")
    if "onnx" in kinds:
        require_extra("onnx", "onnxscript")


def export_npz(policy: Policy, path: str | Path) -> Path:
    """Write all robots' actors as arrays that ``robot.ExportedPolicy`` reads.

    Args:
        policy: the team.
        path: file to write, ending in .npz.

    Raises:
        ValueError: for another ending, a folder that does not exist, actors that read more than
            robots compute, weights that are not finite, or a network without a numpy twin.
    """
    path = Path(path)
    if path.suffix != ".npz" or not path.parent.is_dir():
        raise ValueError(
            f"path={str(path)!r} is not allowed: it must end in .npz, in an existing folder"
        )
    require_exportable(policy, ("npz",))
    weights = policy.actors.state_dict()
    arrays = {name: tensor.float().numpy() for name, tensor in weights.items()}
    with atomic_write(path) as unfinished, unfinished.open("wb") as file:
        save_arrays(file, spec_text(policy), arrays)
    return path


def export_onnx(policy: Policy, folder: str | Path) -> list[Path]:
    """Write every robot's actor as ``robot_<i>.onnx``; needs the extra "export".

    Inputs are fov, fpr, net and action_mask, outputs action and masked_logits, with any number of
    rows; of actors that choose among goals, the candidates, and choice and masked_logits, with any
    number of teammates. Metadata hold the spec, the robot, and what is not in the graph.

    Args:
        policy: the team.
        folder: where to write; created if it does not exist.

    Raises:
        ModuleNotFoundError: when onnx or onnxscript is not installed, saying how to install it.
        ValueError: for actors that read more than robots compute, and weights that are not finite.
    """
    require_exportable(policy, ("onnx",))
    import onnx

    told = spec_text(policy)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for robot in range(policy.config.arena.num_agents):
        model, missing = _graph(policy.actor_of(robot), policy.config.arena)
        described = {"spec": told, "robot": str(robot), "not in the graph": missing}
        onnx.helper.set_model_props(model, described)
        path = folder / f"robot_{robot}.onnx"
        with atomic_write(path) as unfinished:
            onnx.save(model, unfinished)
        paths.append(path)
    return paths


def _graph(actor: nn.Module, arena: ArenaConfig) -> tuple[Any, str]:
    """An onnx.ModelProto, and what is not in it."""
    rows, team = torch.export.Dim("rows"), torch.export.Dim("team")
    if isinstance(actor, GoalActor):
        graph: nn.Module = GoalGraph(actor)
        example: Sequence[Tensor] = example_candidates(2)
        names = GOAL_INPUTS, GOAL_OUTPUTS
        shapes: Any = (({0: rows}, {0: rows, 2: team}, {0: rows, 1: team}, {0: rows}),)
        missing = GOALS_NOT_IN_THE_GRAPH
    else:
        graph, example = Deployed(actor), example_inputs(arena, 2)
        names = INPUTS, OUTPUTS
        shapes, missing = [{0: rows} for _ in example], NOT_IN_THE_GRAPH
    program = torch.onnx.export(
        graph.float().eval(),
        tuple(example),
        input_names=names[0],
        output_names=names[1],
        dynamic_shapes=shapes,
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    return program.model_proto, missing


def example_inputs(arena: ArenaConfig, rows: int, seed: int = 0) -> Sequence[Tensor]:
    """Random observations of one robot: fov, fpr, net and action_mask, ``rows`` of each."""
    chance = torch.Generator().manual_seed(seed)
    shape = {
        "fov": (rows, arena.fov_size, arena.fov_size),
        "fpr": (rows, NUM_DIRECTIONS, NUM_FEATURES),
        "net": (rows, arena.num_agents),
    }
    fov, fpr, net = (torch.rand(size, generator=chance) for size in shape.values())
    mask = torch.rand(rows, NUM_ACTIONS, generator=chance) > 0.4
    mask[:, -2] = True  # staying is always allowed
    return (fov > 0.7).float(), fpr, (net > 0.5).float(), mask


def example_candidates(arenas: int, team: int = 3, steps: int = 6) -> Candidates:
    """Candidates float32 of all robots after some random steps, of ``arenas`` x ``team`` robots."""
    env = ExplorationEnv(ArenaConfig(num_agents=team), arenas)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        last = env.rollout(steps)[:, -1]
    known = RememberTeam(sight=env.config.sight)(last)
    found = find_candidates(known, env.config.sight)
    return Candidates(*(entry.flatten(0, 1).float() for entry in found))
