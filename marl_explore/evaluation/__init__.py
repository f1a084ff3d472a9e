"""Evaluation on unseen arenas: episodes, measures, statistics, tables, figures, replays.

It imports policies, planners and environments, but nothing from training.
"""
