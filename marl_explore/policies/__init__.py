"""Policies: networks, the actors of a team, policy files, export, and bundled policies.

Import ``policy``, ``io``, ``actors`` and ``networks``; ``training`` trains them.
"""
