"""Connected components of free cells."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

# A legal diagonal move has a free cell beside it, so straight moves connect the same cells as legal
# moves. Cells are not connected along the third dimension, the batch.
_STRAIGHT = np.array([np.zeros((3, 3)), [[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.zeros((3, 3))])


def largest_component(free: Tensor) -> Tensor:
    """The largest set of cells connected by legal moves; of several, the first in row order.

    Args:
        free: bool [A, H, W].

    Returns:
        bool [A, H, W].
    """
    labels, _ = ndimage.label(free.cpu().numpy(), _STRAIGHT)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0  # the obstacles
    cells = labels.reshape(len(labels), -1)
    first = sizes[cells].argmax(1, keepdims=True)
    largest = np.take_along_axis(cells, first, 1)[:, :, None]
    return torch.from_numpy(labels == largest).to(free.device) & free
