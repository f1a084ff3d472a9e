"""A module with a fault."""

raise KeyError(7)
