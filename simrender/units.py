"""Strict unit strings: ``"12.5 GB/s"``, ``"100 Gb/s"``, ``"16 GiB"``, ``"3 us"``, ``"230 Mray/s"``.

A quantity is a number and a unit, and both are required: a bare number where a bandwidth is expected is an error, and
so is a unit of the wrong dimension. ``b`` is a bit and ``B`` a byte; ``k M G T P`` are powers of 1000 and
``Ki Mi Gi Ti Pi`` powers of 1024. Values come out in SI units (bytes, seconds, rays), as plain floats.
"""

from __future__ import annotations

import math
import re
from typing import Final

from simrender.errors import UnitError, did_you_mean

BYTES: Final = "B"
SECONDS: Final = "s"
RAYS: Final = "ray"
BYTES_PER_SECOND: Final = "B/s"
RAYS_PER_SECOND: Final = "ray/s"
NUMBER: Final = "1"

_EXAMPLES: Final = {
    BYTES: ("a size", "'16 GiB'"),
    SECONDS: ("a time", "'2.5 us'"),
    RAYS: ("a number of rays", "'4096 ray'"),
    BYTES_PER_SECOND: ("a bandwidth", "'12.5 GB/s'"),
    RAYS_PER_SECOND: ("a ray rate", "'230 Mray/s'"),
    NUMBER: ("a number", "'8'"),
}

_DECIMAL: Final = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "P": 1e15}
_BINARY: Final = {f"{p}i": 1024.0 ** (i + 1) for i, p in enumerate("KMGTP")}


def _table() -> dict[str, tuple[str, float]]:
    """Every unit that can be written, with its dimension and its size in SI units."""
    units: dict[str, tuple[str, float]] = {}
    for prefix, factor in (_DECIMAL | _BINARY).items():
        for symbol, size in (("B", 1.0), ("b", 0.125)):
            units[f"{prefix}{symbol}"] = (BYTES, factor * size)
            units[f"{prefix}{symbol}/s"] = (BYTES_PER_SECOND, factor * size)
    for prefix, factor in _DECIMAL.items():
        units[f"{prefix}ray"] = (RAYS, factor)
        units[f"{prefix}ray/s"] = (RAYS_PER_SECOND, factor)
    units.update({s: (SECONDS, f) for s, f in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9))})
    units["ps"] = (SECONDS, 1e-12)
    units["%"] = (NUMBER, 0.01)
    return units


_UNITS: Final = _table()
_QUANTITY: Final = re.compile(
    r"\s*([-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)\b)\s*(.*?)\s*", re.I
)


def describe(dimension: str) -> str:
    """Return what a dimension is called, with an example: ``"a bandwidth such as '12.5 GB/s'"``."""
    name, example = _EXAMPLES[dimension]
    return f"{name} such as {example}"


def parse(text: str | float, dimension: str) -> float:
    """Read a quantity of the given dimension and return it in SI units.

    Parameters
    ----------
    text : str or number
        A number followed by a unit. A number alone is read only where a plain number is expected.
    dimension : str
        One of the constants of this module, for instance `BYTES_PER_SECOND`.

    Raises
    ------
    UnitError
        With what was expected and, where one is near, the unit that was probably meant.

    """
    expected = f"expected {describe(dimension)}"
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise UnitError(f"{expected}, got {text!r}")
    if not isinstance(text, str):
        if dimension != NUMBER:
            raise UnitError(f"{expected}, got the number {text!r} without a unit")
        return _finite(float(text), expected)
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UnitError(f"{expected}, got {text!r}")
    number, unit = float(match[1].replace("_", "")), match[2]
    if unit == "":
        if dimension != NUMBER:
            raise UnitError(f"{expected}, got {text!r} without a unit")
        return _finite(number, expected)
    if unit not in _UNITS:
        raise UnitError(f"unknown unit {unit!r}{did_you_mean(unit, _candidates(unit, dimension))} ({expected})")
    found, factor = _UNITS[unit]
    if found != dimension:
        raise UnitError(f"{expected}, got {_EXAMPLES[found][0]}: {text!r}")
    # Dividing by 1e6 rounds correctly where multiplying by 1e-6 would not: 2.5 us is 2.5e-6 s to the last bit.
    return _finite(number * factor if factor >= 1.0 else number / round(1.0 / factor), expected)


def _finite(value: float, expected: str) -> float:
    if not math.isfinite(value):
        raise UnitError(f"{expected}, got {value}, which is not a finite number")
    return value


def _candidates(unit: str, dimension: str) -> list[str]:
    """Return the units worth suggesting for an unknown one: those of the expected dimension first."""
    spelled_out = (
        unit.replace("bps", "b/s").replace("Bps", "B/s").replace("bit", "b").replace("yte", "").removesuffix("s/s")
    )
    if spelled_out in _UNITS:
        return [spelled_out]
    same = [u for u, (d, _) in _UNITS.items() if d == dimension]
    return same or list(_UNITS)


def format_bytes(value: float) -> str:
    """Return a size for a person, in decimal units with three significant digits: ``"48.5 GB"``."""
    return _format(value, "B", 1000.0)


def format_seconds(value: float) -> str:
    """Return a duration for a person: ``"345 ms"``, ``"2.5 us"``."""
    for unit, factor in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if value >= factor or unit == "ns":
            return f"{value / factor:.3g} {unit}"
    raise AssertionError("unreachable")


def format_count(value: float) -> str:
    """Return a large number for a person: ``"3.1 G"``, ``"24 M"``."""
    return _format(value, "", 1000.0)


def _format(value: float, unit: str, base: float) -> str:
    for prefix in ("", "k", "M", "G", "T"):
        if abs(value) < 999.5 or prefix == "T":
            return f"{value:.3g} {prefix}{unit}".rstrip()
        value /= base
    raise AssertionError("unreachable")
