"""The rules of the task as pure functions on torch tensors (docs/environment.md).

Every function takes any leading batch dimensions, written ``*B`` below; ``N`` is the number of
robots, ``H x W`` the grid. Nothing here keeps state, and nothing loops over arenas or robots.
"""
