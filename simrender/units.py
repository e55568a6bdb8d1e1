"""Strict unit strings: ``"12.5 GB/s"``, ``"100 Gb/s"``, ``"16 GiB"``, ``"3 us"``, ``"230 Mray/s"``.

A quantity is a number and a unit, and both are required: a bare number where a bandwidth is expected is an error, and
so is a unit of the wrong dimension. ``b`` is a bit and ``B`` a byte; ``k M G T P`` are powers of 1000 and
``Ki Mi Gi Ti Pi`` powers of 1024. Values come out in SI units (bytes, seconds, rays), as plain floats.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import Final

from simrender.errors import UnitError, did_you_mean

BYTES: Final = "B"
SECONDS: Final = "s"
RAYS: Final = "ray"
BYTES_PER_SECOND: Final = "B/s"
RAYS_PER_SECOND: Final = "ray/s"
PRIMITIVES_PER_SECOND: Final = "tri/s"
NUMBER: Final = "1"

_EXAMPLES: Final = {
    BYTES: ("a size", "'16 GiB'"),
    SECONDS: ("a time", "'2.5 us'"),
    RAYS: ("a number of rays", "'4096 ray'"),
    BYTES_PER_SECOND: ("a bandwidth", "'12.5 GB/s'"),
    RAYS_PER_SECOND: ("a ray rate", "'230 Mray/s'"),
    PRIMITIVES_PER_SECOND: ("a rate of triangles", "'50 Mtri/s'"),
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
        units[f"{prefix}tri/s"] = (PRIMITIVES_PER_SECOND, factor)
    units.update({s: (SECONDS, f) for s, f in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9))})
    units["\u03bcs"] = units["µs"]  # the Greek letter, which looks the same
    units["ps"] = (SECONDS, 1e-12)
    units["%"] = (NUMBER, 0.01)
    return units


_UNITS: Final = _table()
_QUANTITY: Final = re.compile(
    r"\s*([-+]?(?:\d+(?:_\d+)*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)\b)\s*(.*?)\s*", re.I
)


def describe(dimension: str) -> str:
    """Return what a dimension is called, with an example: ``"a bandwidth such as '12.5 GB/s'"``."""
    name, example = _EXAMPLES[dimension]
    return f"{name} such as {example}"


def parse(text: object, dimension: str) -> float:
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
        raise UnitError(f"{expected}, got {'nothing' if text is None else repr(text)}")
    if not isinstance(text, str):
        if dimension != NUMBER:
            raise UnitError(f"{expected}, got the number {text!r} without a unit")
        return _finite(text, expected)
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UnitError(f"{expected}, got {text!r}")
    number, unit = float(match[1]), match[2]
    if unit == "":
        if dimension != NUMBER:
            raise UnitError(f"{expected}, got {text!r} without a unit")
        return _finite(number, expected)
    if unit not in _UNITS:
        raise UnitError(f"unknown unit {unit!r}{_suggestion(unit, dimension)} ({expected})")
    found, factor = _UNITS[unit]
    if found != dimension:
        raise UnitError(f"{expected}, got {_EXAMPLES[found][0]}: {text!r}")
    _finite(number, expected)
    exact = Fraction(match[1]) if number else Fraction(0)
    # In fractions, because 0.1 us is 1e-7 s to the last bit, and 0.1 / 1e6 is not.
    return _finite(exact * Fraction(factor) if factor >= 1.0 else exact / round(1.0 / factor), expected)


def _finite(number: float | Fraction, expected: str) -> float:
    try:
        value = float(number)
    except OverflowError:  # hundreds of digits
        value = math.inf
    if not math.isfinite(value):
        raise UnitError(f"{expected}, got {value}, which is not a finite number")
    return value


def _suggestion(unit: str, dimension: str) -> str:
    """Return which unit was probably meant: the same one spelled out, or the nearest of the expected dimension."""
    short = unit.replace("bps", "b/s").replace("Bps", "B/s")
    for word, symbol in (("[Bb]ytes?", "B"), ("[Bb]its?", "b"), ("sec(ond)?s?", "s"), ("rays", "ray")):
        short = re.sub(word, symbol, short)
    meant = [spelled for spelled in (short, f"{unit}B") if spelled in _UNITS]
    if meant:
        return f"; did you mean {meant[0]!r}?"
    return did_you_mean(unit, [u for u, (d, _) in _UNITS.items() if d == dimension])


def format_bytes(value: float) -> str:
    """Return a size for a person, in decimal units with three significant digits: ``"48.5 GB"``."""
    return _format(value, "B", 1000.0)


def format_seconds(value: float) -> str:
    """Return a duration for a person: ``"345 ms"``, ``"2.5 us"``."""
    for unit, factor in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if value >= 0.9995 * factor or unit == "ns":
            return f"{_three_digits(value / factor)} {unit}"
    raise AssertionError("unreachable")


def format_count(value: float) -> str:
    """Return a large number for a person: ``"3.1 G"``, ``"24 M"``."""
    return _format(value, "", 1000.0)


def _format(value: float, unit: str, base: float) -> str:
    for prefix in ("", "k", "M", "G", "T", "P"):
        if abs(value) < 999.5 or prefix == "P":
            return f"{_three_digits(value)} {prefix}{unit}".rstrip()
        value /= base
    raise AssertionError("unreachable")


def _three_digits(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
