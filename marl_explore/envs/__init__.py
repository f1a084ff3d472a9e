"""The exploration task as a TorchRL environment: state, specs, steps, and a factory.

Import ``exploration.ExplorationEnv`` or ``factory.make_env``; the rules are in ``core``.
"""
