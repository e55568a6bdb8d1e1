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

    Fragments may come in any order and from any rank: those of a ray are sorted by depth, equal depths by domain, so
    the image is the same wherever it is made.

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

    Raises
    ------
    IndexError
        If a fragment is of a ray that does not exist.

    """
    if len(ray) and not (ray.min() >= 0 and ray.max() < rays):
        raise IndexError(f"a fragment is of ray {ray.min() if ray.min() < 0 else ray.max()}, but there are {rays} rays")
    image = np.zeros((rays, 4), np.float32)
    _fold(
        np.asarray(rgba, np.float32),
        np.asarray(depth, np.float64),
        np.asarray(ray, np.int64),
        np.asarray(domain, np.int64),
        image,
    )
    return image


@njit(cache=True, nogil=True, error_model="numpy")
def _fold(rgba, depth, ray, domain, image):  # type: ignore[no-untyped-def]
    """Fill each ray's pixel from its fragments, front to back."""
    n, rays = len(ray), len(image)
    # A counting sort by ray, then a Shell sort of each ray's few fragments, beats one sort of everything.
    first = np.zeros(rays + 1, np.int64)
    for i in range(n):
        first[ray[i] + 1] += 1
    for r in range(rays):
        first[r + 1] += first[r]
    order, fill = np.empty(n, np.int64), first.copy()
    for i in range(n):
        order[fill[ray[i]]] = i
        fill[ray[i]] += 1
    for r in range(rays):
        begin, end = first[r], first[r + 1]
        gap = 1
        while 3 * gap < end - begin:
            gap = 3 * gap + 1
        while gap > 0:
            for j in range(begin + gap, end):
                i, k = order[j], j - gap
                while k >= begin and _behind(order[k], i, depth, domain):
                    order[k + gap] = order[k]
                    k -= gap
                order[k + gap] = i
            gap //= 3
        red, green, blue, through = 0.0, 0.0, 0.0, 1.0
        for j in range(begin, end):
            i = order[j]
            red += through * rgba[i, 0]
            green += through * rgba[i, 1]
            blue += through * rgba[i, 2]
            through *= 1.0 - rgba[i, 3]
        image[r, 0], image[r, 1], image[r, 2], image[r, 3] = red, green, blue, 1.0 - through


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _behind(i, j, depth, domain):  # type: ignore[no-untyped-def]
    """Whether fragment i of a ray is to be blended after fragment j."""
    if depth[i] != depth[j]:
        return depth[i] > depth[j]
    return domain[i] > domain[j] if domain[i] != domain[j] else i > j
