"""Replays: episodes as one HTML file that plays in any browser, offline."""

from marl_explore.evaluation.replay.page import write_replay

__all__ = ["write_replay"]
