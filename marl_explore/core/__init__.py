"""The rules of the task as pure functions on torch tensors (docs/environment.md).

Every function takes any leading batch dimensions, written ``*B``; ``N`` is the number of robots and
``H x W`` the size of the grid. Nothing here keeps state or loops over arenas or robots.
"""
