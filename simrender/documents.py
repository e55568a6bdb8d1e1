"""Documents: YAML mappings that know where each of their values was written, laid over one another and validated.

A card may extend another one, and a variant changes its card: both are one document laid over another. Sections merge
field by field; a value with provenance (a mapping with the field ``value``), a list or a single value replaces the one
below as a whole; ``null`` takes away what lies below. Each value keeps the file, line and column where it was written.

All mistakes of a card are reported at once, each as ``file:line:column: path: message``.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Final, TypeVar

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from simrender.errors import CardError, UsageError, did_you_mean

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

BESIDE_FIELDS: Final = ("extends", "variants")
"""What a card may say besides the fields of its model; both are taken out before it is validated."""

_MISSING: Final = ("missing", "missing_argument")

Path = tuple[str | int, ...]
T = TypeVar("T")


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
    name : str
        What to call the card where its values are told from those of the cards it extends.

    Attributes
    ----------
    data : dict
        The fields, as plain data.
    positions, keys : dict
        ``file:line:column`` of each value, and of the name of each field.
    variants : dict of str to Document
        The card as each of its variants changes it; see `split_variants`.

    Raises
    ------
    CardError
        If the text is not YAML, or not a mapping.

    """

    def __init__(self, text: str, where: str, name: str = "") -> None:
        self.where, self.name = where, name
        self.prefix: Path = ()
        self.variants: dict[str, Document] = {}
        self._files: tuple[str, ...] = (where,)
        self._origins: dict[Path, tuple[str, Path]] = {}
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
        inner = copy.copy(self)
        inner.data, inner.prefix, inner.variants, inner._mistakes = dict(data), (*self.prefix, name), {}, []
        inner.positions = _below(name, self.positions) or {(): self.position(())}
        inner.keys = _below(name, self.keys)
        inner._origins = {p: (card, (*prefix, name)) for p, (card, prefix) in _below(name, self._origins).items()}
        return inner

    def _nearest(self, path: Path) -> Path:
        while path not in self.positions:
            path = path[:-1]
        return path

    def position(self, path: Path) -> str:
        """Return ``file:line:column`` of a path, or of the nearest section around it."""
        return self.positions[self._nearest(path)]

    def origin(self, path: Path) -> str:
        """Return the name of the card or variant that says the value at a path."""
        return self._origin(path)[0]

    def _origin(self, path: Path) -> tuple[str, Path]:
        """Return the name of the card or variant that says a value, and what its paths begin with there."""
        return self._origins.get(self._nearest(path), (self.name, self.prefix))

    def over(self, lower: Document) -> Document:
        """Return this document laid over another: what it does not say holds as the other says it.

        Neither of the two is changed.
        """
        merged = copy.copy(self)
        merged.data, replaced = copy.deepcopy(lower.data), set[Path]()
        _lay(self.data, merged.data, (), replaced)
        kept = [p for p in lower.positions if not any(p[:n] in replaced for n in range(1, len(p) + 1))]
        merged.positions = {**{p: lower.positions[p] for p in kept}, **self.positions}
        merged.keys = {**{p: lower.keys[p] for p in kept if p in lower.keys}, **self.keys}
        merged.keys = {p: at for p, at in merged.keys.items() if merged._has(p)}  # null took some away
        merged._origins = {**{p: lower._origin(p) for p in kept}, **{p: self._origin(p) for p in self.positions}}
        merged._files = tuple(dict.fromkeys((*self._files, *lower._files)))
        merged._mistakes = [*self._mistakes, *lower._mistakes]
        return merged

    def take(self, name: str) -> Any:
        """Take a field out of the document and return its value."""
        self.positions = {p: at for p, at in self.positions.items() if p[:1] != (name,)}
        self.keys = {p: at for p, at in self.keys.items() if p[:1] != (name,)}
        return self.data.pop(name)

    def split_variants(self) -> None:
        """Take out the section ``variants``, and lay each of them over what is left: these are `variants`.

        A variant without a title of its own is called by the card's title and its name. A variant that is none is a
        mistake, which `validate` reports with the others.
        """
        if "variants" not in self.data:
            return
        given = self.data["variants"]
        changes = self.section("variants", given if isinstance(given, dict) else {})
        self.take("variants")
        if not isinstance(given, dict):
            message = "expected a mapping of names to the fields that differ"
            self._mistakes.append(f"{changes.position(())}: variants: {message}, got {_clipped(given)}")
        for name, fields in changes.data.items():
            whole, at = f"variants.{name}", changes.position((name,))
            if not re.fullmatch(r"[^\s:/\\]+", name):
                key = changes.keys[name,]
                self._mistakes.append(f"{key}: {whole}: the name of a variant has no blank, colon or slash")
            elif not isinstance(fields, dict):
                message = "expected a mapping of the fields that differ"
                self._mistakes.append(f"{at}: {whole}: {message}, got {_clipped(fields)}")
            else:
                change = changes.section(name, fields)
                change.name = f"{changes.origin((name,))}:{name}"
                change._origins = {p: (f"{card}:{name}", prefix) for p, (card, prefix) in change._origins.items()}
                variant = change.over(self)
                if "title" not in fields and isinstance(title := self.data.get("title"), str):
                    variant.data["title"] = f"{title}, variant {name}"
                self.variants[name] = variant

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
            outer, target = target, target.get(part) if isinstance(target, dict) else target[int(part)]
            if target is None and depth == len(parts) - 2 and _stands_alone(shape, parts[-1]):
                target = outer[part] = {}
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

    def check(self) -> None:
        """Raise the mistakes that show before the model of the card is known: those of its variants."""
        if self._mistakes:
            raise CardError(sorted(self._mistakes, key=self._place))

    def validate(self, model: type[T]) -> T:
        """Return the document as the given pydantic model or dataclass, or raise every mistake at once.

        The variants that the card itself writes are checked too; one that it inherits, when it is used.
        """
        card, errors = _read(self.data, model)
        # Each branch of a union complains, in the same words.
        mistakes = dict.fromkeys([*self._mistakes, *(self._explain(e, model) for e in errors)])
        known = {_fingerprint(e) for e in errors}
        for name, variant in self.variants.items():
            if variant.name == f"{self.name}:{name}":
                for error in _read(variant.data, model)[1]:
                    path = variant._path(error)[0]
                    if _fingerprint(error) not in known and variant._origin(path)[1][:1] == ("variants",):
                        mistakes[variant._explain(error, model)] = None
        if mistakes or card is None:
            raise CardError(sorted(mistakes, key=self._place))
        return card

    def _place(self, mistake: str) -> tuple[float, ...]:
        """Return file, line and column of a mistake: first the card, then those it extends, then a ``--set``."""
        for rank, where in enumerate(self._files):
            found = re.match(r":(\d+):(\d+):", mistake.removeprefix(where))
            if found:
                return rank, int(found[1]), int(found[2])
        return (math.inf,)

    def _path(self, error: Any) -> tuple[Path, str]:
        """Return where in the document a mistake is, and what kind it is of."""
        kind: str = error["type"]
        place = error["loc"]
        named = len(place) - 1 if kind in {"extra_forbidden", "unexpected_keyword_argument"} else -1
        # pydantic names validators in angle brackets; an unknown field may be called so too.
        path: Path = tuple(p for i, p in enumerate(place) if i == named or not str(p).startswith("<"))
        if path and kind not in _MISSING and not self._has(path):
            return path[:-1], "union"  # the last part names a branch
        return path, kind

    def _explain(self, error: Any, model: type[Any]) -> str:
        path, kind = self._path(error)
        message, given = error["msg"], _clipped(error.get("input"))
        position = self.position(path)
        if kind in {"extra_forbidden", "unexpected_keyword_argument"}:
            known = _fields_at(model, path[:-1])
            words = [*known, *BESIDE_FIELDS] if len((*self.prefix, *path)) == 1 else known
            message = f"unknown field{did_you_mean(str(path[-1]), words)} (known: {', '.join(known)})"
            position = self.keys.get(path, position)
        elif kind in _MISSING:
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
        whole = dotted((*self._origin(path)[1], *path))
        return f"{position}: {whole}: {message}" if whole else f"{position}: {message}"


def _read(data: dict[str, Any], model: type[T]) -> tuple[T | None, list[Any]]:
    """Return the data as a model, or None and what pydantic has against them."""
    try:
        return TypeAdapter(model).validate_python(data), []
    except ValidationError as error:
        return None, list(error.errors(include_url=False))


def _fingerprint(error: Any) -> tuple[Any, ...]:
    """Return what tells a mistake of a variant from one that its card makes already."""
    given = error.get("input")
    return error["loc"], error["type"], error["msg"], None if isinstance(given, dict) else repr(given)


def _below(name: str, facts: Mapping[Path, T]) -> dict[Path, T]:
    """Return what is known of the paths in one section, by their paths from there."""
    return {p[1:]: fact for p, fact in facts.items() if p[:1] == (name,)}


def _lay(upper: dict[str, Any], lower: dict[str, Any], path: Path, replaced: set[Path]) -> None:
    """Lay a section over another, which is changed; note the paths of which nothing of the lower one is left."""
    for name, value in upper.items():
        below, here = lower.get(name), (*path, name)
        if isinstance(value, dict) and isinstance(below, dict) and "value" not in value and "value" not in below:
            _lay(value, below, here, replaced)
            continue
        replaced.add(here)
        if value is None and name in lower:
            del lower[name]
        else:
            lower[name] = copy.deepcopy(value)


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


def _stands_alone(shape: Any, part: str | int) -> bool:
    """Tell whether a section that is not there would be complete with one field."""
    shape = _without_optional(shape)
    if not (isinstance(shape, type) and issubclass(shape, BaseModel)):
        return False
    return [name for name, field in shape.model_fields.items() if field.is_required()] == [part]


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
