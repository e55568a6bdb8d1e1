"""Cards: YAML files that describe machines and workloads, validated by pydantic models, with provenance.

No number about hardware or a published scene stands in code. A quantity on a card is plain (``48 GiB``) or says where
it comes from::

    bandwidth: {value: 145.57 GB/s, range: [140 GB/s, 146 GB/s], source: "p2pBandwidthLatencyTest", status: measured}

How the files are read, extended and checked is the business of `simrender.documents`.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from simrender import units
from simrender.documents import Document, dotted, split_assignments, written
from simrender.errors import UnitError

__all__ = [
    "UNCALIBRATED",
    "Bandwidth",
    "Card",
    "Count",
    "Document",
    "Duration",
    "Quantity",
    "RayCount",
    "RayRate",
    "Share",
    "Size",
    "Status",
    "dotted",
    "split_assignments",
    "written",
]

Status = Literal["published", "measured", "derived", "assumed", "calibrated", "stated"]
"""Where a value comes from; ``stated`` is a plain value, whose card vouches for it as a whole."""

UNCALIBRATED: Final = ("assumed", "calibrated")
"""The statuses that a result has to own up to."""


class Quantity(float):
    """A float in SI units that remembers where it comes from.

    Attributes
    ----------
    status : str
        One of `Status`.
    source : str
        Free text; empty for a plain value.
    range : (float, float) or None
        The lowest and highest plausible value, in SI units.
    text : str
        The value as it was written, with its unit.

    """

    __slots__ = ("range", "source", "status", "text")

    status: Status
    source: str
    range: tuple[float, float] | None
    text: str

    def __new__(
        cls,
        value: float,
        text: str = "",
        status: Status = "stated",
        source: str = "",
        range: tuple[float, float] | None = None,  # noqa: A002 - the card's own word
    ) -> Quantity:
        """Make a quantity; `text` defaults to the number."""
        self = super().__new__(cls, value)
        self.text, self.status, self.source, self.range = text or repr(float(value)), status, source, range
        return self


class _Reads:
    """Pydantic annotation: reads a quantity of one dimension, plain or with provenance."""

    def __init__(
        self, dimension: str, *, above: float = 0.0, allow_equal: bool = False, at_most: float = math.inf
    ) -> None:
        self.dimension, self.above, self.allow_equal, self.at_most = dimension, above, allow_equal, at_most

    def _number(self, text: Any) -> float:
        try:
            value = units.parse(text, self.dimension)
        except UnitError as error:
            raise PydanticCustomError("quantity", "{message}", {"message": str(error)}) from None
        if value < self.above or (value == self.above and not self.allow_equal):
            words = f"must be {'at least' if self.allow_equal else 'more than'} {self.above:g}, got {text!r}"
            raise PydanticCustomError("quantity", "{message}", {"message": words})
        if value > self.at_most:
            words = f"must be at most {self.at_most:g}, got {text!r}"
            raise PydanticCustomError("quantity", "{message}", {"message": words})
        return value

    def _plain(self, text: Any) -> Quantity:
        return text if isinstance(text, Quantity) else Quantity(self._number(text), written(text))

    def _with_provenance(self, fields: dict[str, Any]) -> Quantity:
        value, text = fields["value"]
        between = tuple(bound for bound, _ in fields["range"]) if fields.get("range") else None
        if between and not between[0] <= value <= between[1]:
            words = f"the value {text!r} lies outside its own range"
            raise PydanticCustomError("quantity", "{message}", {"message": words})
        return Quantity(value, text, fields.get("status", "stated"), fields.get("source", ""), between)

    def __get_pydantic_core_schema__(self, _source: Any, _handler: GetCoreSchemaHandler) -> CoreSchema:
        number = core_schema.no_info_plain_validator_function(lambda text: (self._number(text), written(text)))
        field = core_schema.typed_dict_field
        statuses = list(typing.get_args(Status))
        fields = core_schema.typed_dict_schema(
            {
                "value": field(number, required=True),
                "range": field(core_schema.tuple_schema([number, number]), required=False),
                "source": field(core_schema.str_schema(), required=False),
                "status": field(core_schema.literal_schema(statuses), required=False),
            },
            extra_behavior="forbid",
        )
        return core_schema.tagged_union_schema(
            {
                "<plain>": core_schema.no_info_plain_validator_function(self._plain),
                "<provenance>": core_schema.no_info_after_validator_function(self._with_provenance, fields),
            },
            discriminator=lambda raw: "<provenance>" if isinstance(raw, Mapping) else "<plain>",
        )


Bandwidth = Annotated[Quantity, _Reads(units.BYTES_PER_SECOND)]
Size = Annotated[Quantity, _Reads(units.BYTES, allow_equal=True)]
Duration = Annotated[Quantity, _Reads(units.SECONDS, allow_equal=True)]
RayRate = Annotated[Quantity, _Reads(units.RAYS_PER_SECOND)]
PrimitiveRate = Annotated[Quantity, _Reads(units.PRIMITIVES_PER_SECOND)]
RayCount = Annotated[Quantity, _Reads(units.RAYS, allow_equal=True)]
Count = Annotated[Quantity, _Reads(units.NUMBER)]
Share = Annotated[Quantity, _Reads(units.NUMBER, at_most=1.0)]
"""A part of a whole: more than 0, at most 1, or a percentage."""
Spread = Annotated[Quantity, _Reads(units.NUMBER, allow_equal=True, at_most=1.0)]
"""A relative deviation: from 0 to 1, or a percentage."""


class Card(BaseModel):
    """Base of all cards and their sections: frozen, and an unknown field is a mistake."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False)

    def quantities(self, prefix: str = "") -> Iterator[tuple[str, Quantity]]:
        """Yield every quantity below this section with its path, in the order of the fields."""
        for name in type(self).model_fields:
            yield from _quantities(getattr(self, name), f"{prefix}{name}")


def _quantities(value: Any, path: str) -> Iterator[tuple[str, Quantity]]:
    if isinstance(value, Quantity):
        yield path, value
    elif isinstance(value, Card):
        yield from value.quantities(f"{path}.")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _quantities(item, f"{path}.{i}")
