"""Training: data collection, learning, validation, checkpoints, and sweeps over seeds.

The entry point is ``runs.train``; no lower layer imports this package.
"""
