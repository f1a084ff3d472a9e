"""HAPPO for any TorchRL environment: the loss, and what its factor shows.

It imports nothing of the package but ``utils``; other projects import ``marl_explore.HAPPOLoss``.
"""
