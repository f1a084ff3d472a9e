"""Policies on arenas they never saw: episodes, measures, statistics, tables, figures, replays.

It imports policies, planners and environments, and knows nothing of training.
"""
