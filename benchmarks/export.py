"""How long one robot waits for its network's decision: torch, onnxruntime and numpy, one row.

python -m benchmarks.export   (it takes the extra "export")
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.timing import conditions, medians
from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.actors import probabilistic_actor
from marl_explore.policies.export import INPUTS, Deployed, example_inputs, export_npz, export_onnx
from marl_explore.policies.networks import CNN, MLP, Network
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.robot import ExportedPolicy

NETWORKS = {
    "MLP 2400-300": MLP(),
    "CNN": CNN(),
    "MLP 128-128": MLP(hidden=(128, 128)),
}


def measure(network: Network, repeats: int = 7) -> dict[str, float]:
    """Median microseconds per decision."""
    import onnxruntime

    config = PolicyConfig(ArenaConfig(), network)
    policy = Policy(config, config.make_actors())
    deployed, inputs = Deployed(policy.actors[0]).eval(), example_inputs(config.arena, 1)
    with tempfile.TemporaryDirectory() as folder:
        numpy = ExportedPolicy(export_npz(policy, Path(folder) / "policy.npz"), 0)
        graph = export_onnx(policy, folder)[0].read_bytes()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    arrays = [entry.numpy() for entry in inputs]
    named = dict(zip(INPUTS, arrays, strict=True))
    *observation, mask = inputs
    entries = dict(zip(INPUTS, observation, strict=False))
    td = TensorDict({"agents": {"observation": entries, "action_mask": mask}}, [1])
    actor = probabilistic_actor(policy.actors[0])
    with torch.inference_mode():
        seconds = medians(
            {
                "torch, as TensorDict": lambda: actor(td.clone(recurse=False)),
                "torch": lambda: deployed(*inputs),
                "onnxruntime": lambda: session.run(None, named),
                "numpy": lambda: numpy.masked_logits(*arrays).argmax(-1),
            },
            repeats,
        )
    return {name: value * 1e6 for name, value in seconds.items()}


def main() -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of the exporter
    results = {name: measure(network) for name, network in NETWORKS.items()}
    contenders = list(next(iter(results.values())))
    print(f"microseconds per decision of one robot, {conditions()}")
    print(f"{'':>22}" + "".join(f"{name:>16}" for name in results))
    for contender in contenders:
        row = "".join(f"{result[contender]:16.0f}" for result in results.values())
        print(f"{contender:>22}{row}")


if __name__ == "__main__":
    main()
