"""The over operator on premultiplied colours, and the image that sorted fragments make.

Sort-last renderers blend what each rank saw of a ray front to back (islands paper, sections 4 and 7; Porter and Duff,
"Compositing digital images", SIGGRAPH 1984). The operator is associative but does not commute: ranks may blend
neighbours in any tree, in floating point with differences in the last digits only. `composite` folds front to back in
float64, and is what an image is compared with.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]


def over(front: NDArray[np.floating[Any]], back: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return what is seen of two fragments of which one lies before the other.

    Parameters
    ----------
    front, back : float array (..., 4)
        Premultiplied colour and opacity.

    """
    blended: NDArray[np.floating[Any]] = front + (1.0 - front[..., 3:]) * back
    return blended


def composite(
    rgba: F32,
    depth: NDArray[np.floating[Any]],
    ray: NDArray[np.integer[Any]],
    domain: NDArray[np.integer[Any]],
    rays: int,
) -> F32:
    """Blend the fragments of each ray front to back.

    Fragments may come in any order and from any rank: they are sorted by ray and depth, equal depths by domain, so the
    image is the same wherever and however often it is made.

    Parameters
    ----------
    rgba : float32 array (n, 4)
        Premultiplied colour and opacity of each fragment.
    depth : float array (n,)
        Where it begins along its ray.
    ray : int array (n,)
        Its ray, or pixel, 0 .. rays - 1.
    domain : int array (n,)
        Where it comes from. A domain may give a ray several fragments, of different depths.
    rays : int
        Number of rays.

    Returns
    -------
    float32 array (rays, 4)
        Premultiplied; all 0 for a ray without a fragment.

    """
    image = np.zeros((rays, 4), np.float32)
    order = np.lexsort((domain, depth, ray))
    _fold(np.asarray(rgba, np.float32), np.asarray(ray, np.int64), order, image)
    return image


@njit(cache=True, nogil=True, error_model="numpy")
def _fold(rgba, ray, order, image):  # type: ignore[no-untyped-def]
    """Fill each ray's pixel from its fragments, which ``order`` lists ray by ray and front to back."""
    n = len(order)
    row = 0
    while row < n:
        pixel = ray[order[row]]
        red, green, blue, through = 0.0, 0.0, 0.0, 1.0
        while row < n and ray[order[row]] == pixel:
            i = order[row]
            red += through * rgba[i, 0]
            green += through * rgba[i, 1]
            blue += through * rgba[i, 2]
            through *= 1.0 - rgba[i, 3]
            row += 1
        image[pixel, 0], image[pixel, 1], image[pixel, 2], image[pixel, 3] = red, green, blue, 1.0 - through
