"""Multi-robot exploration with reinforcement learning, on TorchRL.

Every documented name can be imported from here. It is loaded on first use, so that parts without
torch stay light, and modules may move inside the package.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from marl_explore.utils.extras import require_extra

if TYPE_CHECKING:
    from marl_explore.adapters.benchmarl import ExplorationTask as ExplorationTask
    from marl_explore.adapters.benchmarl import HappoConfig as HappoConfig
    from marl_explore.adapters.pettingzoo import parallel_env as parallel_env
    from marl_explore.arenas import Caves as Caves
    from marl_explore.arenas import Corridors as Corridors
    from marl_explore.arenas import MapArenas as MapArenas
    from marl_explore.arenas import Mazes as Mazes
    from marl_explore.arenas import Mixed as Mixed
    from marl_explore.arenas import Rooms as Rooms
    from marl_explore.arenas import Suite as Suite
    from marl_explore.arenas import Uniform as Uniform
    from marl_explore.arenas import UniformV2 as UniformV2
    from marl_explore.arenas import default_config as default_config
    from marl_explore.arenas import default_steps as default_steps
    from marl_explore.arenas import list_suites as list_suites
    from marl_explore.arenas import load_map as load_map
    from marl_explore.arenas import suite as suite
    from marl_explore.cli.common import parse_options as parse_options
    from marl_explore.cli.common import require_package as require_package
    from marl_explore.cli.common import run_program as run_program
    from marl_explore.cli.main import run_command as run_command
    from marl_explore.config.arena import ArenaConfig as ArenaConfig
    from marl_explore.config.checks import require_integer as require_integer
    from marl_explore.config.checks import require_positive as require_positive
    from marl_explore.config.checks import require_share as require_share
    from marl_explore.config.run import RunConfig as RunConfig
    from marl_explore.config.run import parse_seeds as parse_seeds
    from marl_explore.config.shapes import SHAPES as SHAPES
    from marl_explore.config.shapes import Sight as Sight
    from marl_explore.core.links import RADIOS as RADIOS
    from marl_explore.core.native import backend as backend
    from marl_explore.core.rewards import StepRecord as StepRecord
    from marl_explore.envs.exploration import ExplorationEnv as ExplorationEnv
    from marl_explore.envs.factory import make_env as make_env
    from marl_explore.envs.workers import split_arenas as split_arenas
    from marl_explore.evaluation import metrics as metrics
    from marl_explore.evaluation import plots as plots
    from marl_explore.evaluation import stats as stats
    from marl_explore.evaluation.episodes import play as play
    from marl_explore.evaluation.episodes import record as record
    from marl_explore.evaluation.episodes import watch as watch
    from marl_explore.evaluation.knowledge import require_decentralised as require_decentralised
    from marl_explore.evaluation.registry import find_policy as find_policy
    from marl_explore.evaluation.replay import write_replay as write_replay
    from marl_explore.evaluation.results import evaluate as evaluate
    from marl_explore.evaluation.results import format_table as format_table
    from marl_explore.happo.diagnostics import FactorWatch as FactorWatch
    from marl_explore.happo.diagnostics import factor_statistics as factor_statistics
    from marl_explore.happo.loss import HAPPOLoss as HAPPOLoss
    from marl_explore.happo.update import sequential_update as sequential_update
    from marl_explore.lab import LabRunner as LabRunner
    from marl_explore.lab import Noise as Noise
    from marl_explore.planners import PLANNERS as PLANNERS
    from marl_explore.planners import GoalUtility as GoalUtility
    from marl_explore.planners import GoalWeights as GoalWeights
    from marl_explore.planners import PairTimer as PairTimer
    from marl_explore.planners import Planner as Planner
    from marl_explore.planners.communication import CommunicationRule as CommunicationRule
    from marl_explore.policies.actors import MultiAgentActors as MultiAgentActors
    from marl_explore.policies.actors import probabilistic_actor as probabilistic_actor
    from marl_explore.policies.export import export_npz as export_npz
    from marl_explore.policies.export import export_onnx as export_onnx
    from marl_explore.policies.io import list_policies as list_policies
    from marl_explore.policies.io import load_policy as load_policy
    from marl_explore.policies.io import policy_info as policy_info
    from marl_explore.policies.io import save_policy as save_policy
    from marl_explore.policies.networks import CNN as CNN
    from marl_explore.policies.networks import MLP as MLP
    from marl_explore.policies.networks import NETWORKS as NETWORKS
    from marl_explore.policies.networks import DeepSet as DeepSet
    from marl_explore.policies.networks import Goals as Goals
    from marl_explore.policies.networks import Network as Network
    from marl_explore.policies.policy import Policy as Policy
    from marl_explore.policies.policy import PolicyConfig as PolicyConfig
    from marl_explore.robot import BarrierClock as BarrierClock
    from marl_explore.robot import Envelope as Envelope
    from marl_explore.robot import ExportedPolicy as ExportedPolicy
    from marl_explore.robot import Observation as Observation
    from marl_explore.robot import PeriodClock as PeriodClock
    from marl_explore.robot import Pose as Pose
    from marl_explore.robot import RobotCore as RobotCore
    from marl_explore.robot import RobotSettings as RobotSettings
    from marl_explore.robot import Scan as Scan
    from marl_explore.ros2.recordings import replay_recording as replay_recording
    from marl_explore.training.config import TrainConfig as TrainConfig
    from marl_explore.training.loggers import Loggers as Loggers
    from marl_explore.training.nan_guard import require_finite_batch as require_finite_batch
    from marl_explore.training.presets import PRESETS as PRESETS
    from marl_explore.training.run_folder import lengthen as lengthen
    from marl_explore.training.runs import resume as resume
    from marl_explore.training.runs import train as train
    from marl_explore.training.seeds import summarize_seeds as summarize_seeds
    from marl_explore.training.seeds import sweep as sweep
    from marl_explore.transforms import Clock as Clock
    from marl_explore.transforms import CommunicationNeighbors as CommunicationNeighbors
    from marl_explore.transforms import FrontierReachability as FrontierReachability
    from marl_explore.transforms import FrontierTerritory as FrontierTerritory
    from marl_explore.transforms import GoalCandidates as GoalCandidates
    from marl_explore.transforms import LocalMap as LocalMap
    from marl_explore.transforms import RememberTeam as RememberTeam
    from marl_explore.transforms import StepGain as StepGain
    from marl_explore.transforms import Teammates as Teammates
    from marl_explore.transforms.base import FeatureTransform as FeatureTransform
    from marl_explore.transforms.features import FEATURES as FEATURES
    from marl_explore.transforms.features import Feature as Feature
    from marl_explore.utils import records as records
    from marl_explore.utils import tables as tables

_EXPORTS = {
    "adapters.benchmarl": ("ExplorationTask", "HappoConfig"),
    "adapters.pettingzoo": ("parallel_env",),
    "arenas": (
        "Caves",
        "Corridors",
        "MapArenas",
        "Mazes",
        "Mixed",
        "Rooms",
        "Suite",
        "Uniform",
        "UniformV2",
        "default_config",
        "default_steps",
        "list_suites",
        "load_map",
        "suite",
    ),
    "cli.common": ("parse_options", "require_package", "run_program"),
    "cli.main": ("run_command",),
    "config.arena": ("ArenaConfig",),
    "config.checks": ("require_integer", "require_positive", "require_share"),
    "config.run": ("RunConfig", "parse_seeds"),
    "config.shapes": ("SHAPES", "Sight"),
    "core.links": ("RADIOS",),
    "core.native": ("backend",),
    "core.rewards": ("StepRecord",),
    "envs.exploration": ("ExplorationEnv",),
    "envs.factory": ("make_env",),
    "envs.workers": ("split_arenas",),
    "evaluation": ("metrics", "plots", "stats"),
    "evaluation.episodes": ("play", "record", "watch"),
    "evaluation.knowledge": ("require_decentralised",),
    "evaluation.registry": ("find_policy",),
    "evaluation.replay": ("write_replay",),
    "evaluation.results": ("evaluate", "format_table"),
    "happo.diagnostics": ("FactorWatch", "factor_statistics"),
    "happo.loss": ("HAPPOLoss",),
    "happo.update": ("sequential_update",),
    "lab": ("LabRunner", "Noise"),
    "planners": ("PLANNERS", "GoalUtility", "GoalWeights", "PairTimer", "Planner"),
    "planners.communication": ("CommunicationRule",),
    "policies.actors": ("MultiAgentActors", "probabilistic_actor"),
    "policies.export": ("export_npz", "export_onnx"),
    "policies.io": ("list_policies", "load_policy", "policy_info", "save_policy"),
    "policies.networks": ("CNN", "MLP", "NETWORKS", "DeepSet", "Goals", "Network"),
    "policies.policy": ("Policy", "PolicyConfig"),
    "robot": (
        "BarrierClock",
        "Envelope",
        "ExportedPolicy",
        "Observation",
        "PeriodClock",
        "Pose",
        "RobotCore",
        "RobotSettings",
        "Scan",
    ),
    "ros2.recordings": ("replay_recording",),
    "training.config": ("TrainConfig",),
    "training.loggers": ("Loggers",),
    "training.nan_guard": ("require_finite_batch",),
    "training.presets": ("PRESETS",),
    "training.run_folder": ("lengthen",),
    "training.runs": ("resume", "train"),
    "training.seeds": ("summarize_seeds", "sweep"),
    "transforms": (
        "Clock",
        "CommunicationNeighbors",
        "FrontierReachability",
        "FrontierTerritory",
        "GoalCandidates",
        "LocalMap",
        "RememberTeam",
        "StepGain",
        "Teammates",
    ),
    "transforms.base": ("FeatureTransform",),
    "transforms.features": ("FEATURES", "Feature"),
    "utils": ("records", "tables"),
}
"""Modules of the public names; the block above tells type checkers the same."""
_HOMES = {name: home for home, names in _EXPORTS.items() for name in names}

_OPTIONAL = {"adapters.benchmarl": "benchmarl", "lab": "vmas", "ros2.recordings": "rosbags"}
"""Modules that need an optional package; a star import leaves their names out."""

__all__ = sorted(name for name, home in _HOMES.items() if home not in _OPTIONAL)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("marl-explore")
    if name not in _HOMES:
        raise AttributeError(f"module 'marl_explore' has no attribute {name!r}")
    if _HOMES[name] in _OPTIONAL:
        require_extra(_OPTIONAL[_HOMES[name]])
    home = import_module(f"marl_explore.{_HOMES[name]}")
    if not hasattr(home, name):  # a module
        import_module(f"{home.__name__}.{name}")
    return getattr(home, name)


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]
