"""The order in which GNU's C++ library leaves equal elements: what a program that was run left to chance.

`std::sort` is not stable. Where SpRay's program sorts domains with equal keys, its schedule and its partition follow
from the library's introsort (Musser, "Introspective sorting and selection algorithms", 1997): quicksort with the median
of three down to 16 elements, then insertion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_SMALL = 16


def std_sort(count: int, less: Callable[[int, int], bool]) -> list[int]:
    """Return 0 to count - 1 in the order in which ``std::sort`` leaves them.

    Parameters
    ----------
    count : int
    less : callable
        Whether the first element comes before the second.

    Raises
    ------
    RecursionError
        If the input is one of those for which the library falls back to sorting by a heap.

    """
    items = list(range(count))
    if count > _SMALL:
        _introsort(items, 0, count, 2 * (count.bit_length() - 1), less)
        _insert_all(items, 0, _SMALL, less)
        for i in range(_SMALL, count):
            _insert(items, i, less)
    else:
        _insert_all(items, 0, count, less)
    return items


def descending(keys: Any) -> list[int]:
    """Return the indices of some numbers in the order in which ``std::sort`` leaves them, the largest first."""
    values = [float(key) for key in keys]
    return std_sort(len(values), lambda a, b: values[a] > values[b])


def _introsort(items: list[int], first: int, last: int, depth: int, less: Callable[[int, int], bool]) -> None:
    while last - first > _SMALL:
        if depth == 0:
            raise RecursionError("the library would go on with a heap, which is not followed here")
        depth -= 1
        _median_to_first(items, first, first + 1, first + (last - first) // 2, last - 1, less)
        cut = _partition(items, first + 1, last, items[first], less)
        _introsort(items, cut, last, depth, less)
        last = cut


def _median_to_first(items: list[int], to: int, a: int, b: int, c: int, less: Callable[[int, int], bool]) -> None:
    x, y, z = items[a], items[b], items[c]
    if less(x, y):
        median = b if less(y, z) else c if less(x, z) else a
    else:
        median = a if less(x, z) else c if less(y, z) else b
    items[to], items[median] = items[median], items[to]


def _partition(items: list[int], first: int, last: int, pivot: int, less: Callable[[int, int], bool]) -> int:
    while True:
        while less(items[first], pivot):
            first += 1
        last -= 1
        while less(pivot, items[last]):
            last -= 1
        if first >= last:
            return first
        items[first], items[last] = items[last], items[first]
        first += 1


def _insert_all(items: list[int], first: int, last: int, less: Callable[[int, int], bool]) -> None:
    for i in range(first + 1, last):
        if less(items[i], items[first]):
            items[first : i + 1] = [items[i], *items[first:i]]
        else:
            _insert(items, i, less)


def _insert(items: list[int], i: int, less: Callable[[int, int], bool]) -> None:
    value = items[i]
    while less(value, items[i - 1]):
        items[i] = items[i - 1]
        i -= 1
    items[i] = value
