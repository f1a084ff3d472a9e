"""HAPPO for any TorchRL environment: the loss, and diagnostics of its factor.

It imports only ``utils`` from the package; other projects import ``marl_explore.HAPPOLoss``.
"""
