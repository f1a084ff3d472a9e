"""A package of others with policies: nothing of it knows marl_explore, but for the team's."""

__version__ = "1.2"
