"""Cards: YAML files that describe machines and workloads, validated by pydantic models, with provenance.

No number about hardware or a published scene stands in code. A quantity on a card is plain (``48 GiB``) or says where
it comes from::

    bandwidth: {value: 145.57 GB/s, range: [140 GB/s, 146 GB/s], source: "p2pBandwidthLatencyTest", status: measured}

All mistakes of a card are reported at once, each as ``file:line:column: path: message``.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from simrender import units
from simrender.errors import CardError, UnitError, UsageError, did_you_mean

Status = Literal["published", "measured", "derived", "assumed", "calibrated", "stated"]
"""Where a value comes from; ``stated`` is a plain value, whose card vouches for it as a whole."""

_EXPECTED: Final = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "string": "text",
    "list": "a list",
    "tuple": "a list",
    "dict": "a mapping of names to values",
}
"""What pydantic's kinds of mistakes begin with, and what was expected then."""

UNCALIBRATED: Final = ("assumed", "calibrated")
"""The statuses that a result has to own up to."""

Path = tuple[str | int, ...]
T = TypeVar("T")


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
RayCount = Annotated[Quantity, _Reads(units.RAYS, allow_equal=True)]
Count = Annotated[Quantity, _Reads(units.NUMBER)]
Share = Annotated[Quantity, _Reads(units.NUMBER, at_most=1.0)]
"""A part of a whole: more than 0, at most 1, or a percentage."""


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


class _Loader(yaml.SafeLoader):
    """Reads plain data, with the plain scalars of YAML 1.2.

    PyYAML follows YAML 1.1, in which ``no`` is false, ``1:30`` is 90, ``010`` is 8 and ``1e9`` is text. Here only
    ``true`` and ``false`` are truth values, ``1e9`` is a number, and what is neither is text, dates included.
    """


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern in {
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?(?:0|[1-9]\d*)",
    "float": r"[-+]?(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][-+]?\d+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
    "null": r"~|null|Null|NULL|",
}.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z", re.ASCII), None)


class Document:
    """A parsed YAML mapping that knows where each of its values was written.

    Parameters
    ----------
    text : str
        The YAML text; only plain data are read (the safe loader), and a key that stands twice is a mistake.
    where : str
        What to call the file in messages.

    Raises
    ------
    CardError
        If the text is not YAML, or not a mapping.

    """

    def __init__(self, text: str, where: str) -> None:
        self.where = where
        self.prefix: Path = ()
        self.positions: dict[Path, str] = {}
        self.keys: dict[Path, str] = {}
        self._mistakes: list[str] = []
        self._open: set[yaml.Node] = set()
        try:
            node = yaml.compose(text, _Loader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark
            at = f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where
            problem = error.problem or ""
            if problem.startswith("but "):  # the second half of a sentence
                problem = f"{error.context}, {problem}"
            raise CardError([f"{at}: not valid YAML: {problem}"]) from None
        except yaml.YAMLError as error:
            raise CardError([f"{where}: not valid YAML: {' '.join(str(error).split())}"]) from None
        except RecursionError:
            raise CardError([f"{where}: not valid YAML: nested too deeply"]) from None
        if not isinstance(node, yaml.MappingNode):
            got = "nothing" if node is None else "a list" if isinstance(node, yaml.SequenceNode) else "a single value"
            raise CardError([f"{where}:1:1: a card is a mapping of fields, got {got}"])
        self._loader = _Loader("")
        self.data: dict[str, Any] = self._construct(node, ())
        if self._mistakes:
            raise CardError(self._mistakes)

    def _construct(self, node: yaml.Node, path: Path) -> Any:
        self.positions.setdefault(path, self._at(node))
        if node in self._open:
            self._mistake(node, path, "this value contains itself")
            return None
        self._open.add(node)
        value: Any = None
        if isinstance(node, yaml.MappingNode):
            value = {}
            for key_node, value_node in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    self._mistake(key_node, path, "the name of a field is a word, got a list or a mapping")
                    continue
                key = key_node.value
                if key in value:
                    self._mistake(key_node, (*path, key), "this field stands twice")
                self.keys[(*path, key)] = self._at(key_node)
                value[key] = self._construct(value_node, (*path, key))
        elif isinstance(node, yaml.SequenceNode):
            value = [self._construct(item, (*path, i)) for i, item in enumerate(node.value)]
        else:
            try:
                value = self._loader.construct_object(node, deep=True)
            except (yaml.YAMLError, ValueError):
                tag = node.tag.replace("tag:yaml.org,2002:", "!!")
                self._mistake(node, path, f"cannot read {_clipped(node.value)} as {tag}")
        self._open.remove(node)
        return value

    def _mistake(self, node: yaml.Node, path: Path, message: str) -> None:
        self._mistakes.append(": ".join([self._at(node), *([dotted(path)] if path else []), message]))

    def _at(self, node: yaml.Node) -> str:
        return f"{self.where}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"

    def section(self, name: str, data: dict[str, Any]) -> Document:
        """Return a section as a document of its own, with the given content, that still knows where it was written."""
        inner = Document("{}", self.where)
        inner.data, inner.prefix = dict(data), (*self.prefix, name)
        inner.positions = {p[1:]: at for p, at in self.positions.items() if p[:1] == (name,)} or {(): self.position(())}
        inner.keys = {p[1:]: at for p, at in self.keys.items() if p[:1] == (name,)}
        return inner

    def position(self, path: Path) -> str:
        """Return ``file:line:column`` of a path, or of the nearest section around it."""
        while path not in self.positions:
            path = path[:-1]
        return self.positions[path]

    def override(self, model: type[Any], assignment: str, section: str) -> None:
        """Apply one ``--set`` of the form ``path=value``; its path must exist in the model.

        Parameters
        ----------
        model : type
            The pydantic model or dataclass that the document will be validated against.
        assignment : str
            ``nvlink.bandwidth=300 GB/s``, without the section's name.
        section : str
            ``machine``, ``workload`` or ``policy``: for messages.

        Raises
        ------
        CardError
            If the path names no field.

        """
        dotted_path, _, text = assignment.partition("=")
        spelled = f"--set {section}.{dotted_path}"
        parts: Path = tuple(int(p) if re.fullmatch("[0-9]+", p) else p for p in dotted_path.split("."))
        target: Any = self.data
        shape: Any = model
        for depth, part in enumerate(parts):
            here, known = dotted((section, *parts[:depth])), field_types(shape)
            if known is not None and part not in known:
                suggestion = did_you_mean(str(part), known)
                raise CardError(
                    [f"{spelled}: {here} has no field {str(part)!r}{suggestion} (it has: {', '.join(known)})"]
                )
            if not isinstance(target, (dict, list)):
                raise CardError([f"{spelled}: {here} is a single value, without parts"])
            if isinstance(target, list) and (not isinstance(part, int) or part >= len(target)):
                span = f"a list of {len(target)}, whose parts are 0 to {len(target) - 1}"
                raise CardError([f"{spelled}: {here} is {span if target else 'an empty list'}"])
            default, shape = _default(shape, part), known[str(part)] if known is not None else _item_type(shape, part)
            if shape is None:
                raise CardError([f"{spelled}: {here} is a single value, without parts"])
            if depth == len(parts) - 1:
                break
            if isinstance(target, dict) and default is not None:
                target.setdefault(part, default)
            target = target.get(part) if isinstance(target, dict) else target[int(part)]
            if target is None:
                twins = [dotted((section, *p)) for p in self.keys if p[-1] == parts[-1]]
                hint = f"; did you mean {', '.join(twins)}?" if twins else ""
                raise CardError([f"{spelled}: {self.where} has no {dotted((section, *parts[: depth + 1]))}{hint}"])
        try:
            value = yaml.load(text, _Loader)  # noqa: S506 - a safe loader
        except (yaml.YAMLError, ValueError):
            value = text  # let the field say what it expects
        self.positions = {p: at for p, at in self.positions.items() if p[: len(parts)] != parts}
        self.positions[parts] = self.keys[parts] = f"--set {section}."
        target[parts[-1]] = value

    def _has(self, path: Path) -> bool:
        value: Any = self.data
        for part in path:
            if not (part in value if isinstance(value, dict) else isinstance(value, list) and isinstance(part, int)):
                return False
            value = value[part]
        return True

    def validate(self, model: type[T]) -> T:
        """Return the document as the given pydantic model or dataclass, or raise every mistake at once."""
        try:
            return TypeAdapter(model).validate_python(self.data)
        except ValidationError as error:
            # Each branch of a union complains, in the same words.
            mistakes = dict.fromkeys(self._explain(e, model) for e in error.errors(include_url=False))
            raise CardError(sorted(mistakes, key=self._place)) from None

    def _place(self, mistake: str) -> tuple[float, float]:
        """Return line and column of a mistake; those of a ``--set`` come last."""
        found = re.match(r":(\d+):(\d+):", mistake.removeprefix(self.where))
        return (int(found[1]), int(found[2])) if found else (math.inf, math.inf)

    def _explain(self, error: Any, model: type[Any]) -> str:
        path: Path = tuple(p for p in error["loc"] if not (isinstance(p, str) and p.startswith("<")))
        message, kind, given = error["msg"], error["type"], _clipped(error.get("input"))
        if kind not in {"missing", "missing_argument"} and not self._has(path):
            path, kind = path[:-1], "union"  # the last part names a branch
        position = self.position(path)
        if kind in {"extra_forbidden", "unexpected_keyword_argument"}:
            known = _fields_at(model, path[:-1])
            message = f"unknown field{did_you_mean(str(path[-1]), known)} (known: {', '.join(known)})"
            position = self.keys.get(path, position)
        elif kind in {"missing", "missing_argument"}:
            message = "this field is missing"
        elif kind == "literal_error":
            expected = error["ctx"]["expected"]
            choices = [c.strip("' ") for c in expected.replace(" or ", ", ").split(",")]
            message = f"expected {expected}, got {given}{did_you_mean(str(error['input']), choices)}"
        elif kind in {"model_type", "model_attributes_type", "dataclass_type"}:
            message = f"expected a section with the fields {', '.join(_fields_at(model, path))}, got {given}"
        elif kind == "value_error":
            message = message.removeprefix("Value error, ")
        elif kind == "union":
            message = f"expected a single value, got {given}"
        elif kind == "too_long":
            message = f"expected {error['ctx']['max_length']} values, got {given}"
        elif expected := next((words for start, words in _EXPECTED.items() if kind.startswith(start)), None):
            message = f"expected {expected}, got {given}"
        elif kind != "quantity":
            message = f"{message.removeprefix('Input ')}, got {given}"
        if position.endswith("."):  # of a --set
            return f"{position}{dotted(path)}: {message}"
        whole = dotted((*self.prefix, *path))
        return f"{position}: {whole}: {message}" if whole else f"{position}: {message}"


def _clipped(value: Any) -> str:
    text = "nothing" if value is None else written(value) if isinstance(value, float) else repr(value)
    return text if len(text) <= 80 else f"{text[:79]}…"


def written(value: Any) -> str:
    """Return a card's value as a person writes it: ``1e9`` and ``true``, not ``1000000000.0`` and ``True``."""
    if isinstance(value, bool):
        return str(value).lower()
    mantissa, e, exponent = f"{value:g}".partition("e") if isinstance(value, float) else ("", "", "")
    return f"{mantissa}e{int(exponent)}" if e and float(f"{mantissa}e{exponent}") == value else str(value)


def dotted(path: Iterable[str | int]) -> str:
    """Return a path as a person writes it: ``nvlink.bandwidth``."""
    return ".".join(str(p) for p in path)


def field_types(shape: Any) -> dict[str, Any] | None:
    """Return the fields of a card section or dataclass with their types, or None for anything else."""
    shape = _without_optional(shape)
    if isinstance(shape, type) and issubclass(shape, BaseModel):
        return {name: field.annotation if not field.metadata else Annotated[(field.annotation, *field.metadata)]
                for name, field in shape.model_fields.items()}  # fmt: skip
    if dataclasses.is_dataclass(shape):
        hints = typing.get_type_hints(shape, include_extras=True)
        return {f.name: hints[f.name] for f in dataclasses.fields(shape)}
    return None


def _without_optional(shape: Any) -> Any:
    if typing.get_origin(shape) in {typing.Union, types.UnionType}:
        inner = [a for a in typing.get_args(shape) if a is not type(None)]
        return inner[0] if len(inner) == 1 else shape
    return shape


def _item_type(shape: Any, part: str | int) -> Any:
    """Return the type of the items of a list or mapping type, or None if it has no such item."""
    shape = _without_optional(shape)
    origin, arguments = typing.get_origin(shape), typing.get_args(shape)
    if origin in {list, tuple, Sequence} and isinstance(part, int):
        return arguments[0] if arguments else Any
    if origin in {dict, Mapping}:
        return arguments[1] if arguments else Any
    return None


def _default(shape: Any, part: str | int) -> dict[str, Any] | None:
    """Return what stands for a section that a card may leave out, or None if it then has no such section."""
    shape = _without_optional(shape)
    if not (isinstance(shape, type) and issubclass(shape, BaseModel)):
        return None
    default = shape.model_fields[str(part)].get_default(call_default_factory=True, validated_data={})
    return {} if isinstance(default, BaseModel) else dict(default) if isinstance(default, dict) else None


def _fields_at(model: Any, path: Path) -> list[str]:
    for part in path:
        known = field_types(model)
        model = known.get(str(part)) if known else _item_type(model, part)
    if model is not None and typing.get_origin(model) is Annotated:
        return ["value", "range", "source", "status"]
    return list(field_types(model) or ["value", "range", "source", "status"])


def split_assignments(assignments: Iterable[str], sections: Sequence[str]) -> dict[str, list[str]]:
    """Sort ``--set`` options by the section that their path starts with.

    Raises
    ------
    UsageError
        If one has no ``=``, or starts with no known section.

    """
    sorted_: dict[str, list[str]] = {section: [] for section in sections}
    for assignment in assignments:
        path, equals, _ = assignment.partition("=")
        section, dot, rest = path.partition(".")
        if not equals:
            raise UsageError(
                f"--set {assignment}: expected PATH=VALUE, for instance machine.nvlink.bandwidth='300 GB/s'"
            )
        if section not in sorted_ or not dot or not rest:
            suggestion, starts = did_you_mean(section, sections), " or ".join(f"{s}." for s in sections)
            raise UsageError(f"--set {assignment}: a path starts with {starts}, got {path!r}{suggestion}")
        sorted_[section].append(assignment.partition(".")[2])
    return sorted_
