"""Names to machines, workloads and policies.

Content lives outside simrender and is found through entry points, so that a third party's machines, scenes and
schedulers plug in like our own: the groups ``simrender.machines`` and ``simrender.workloads`` name Python packages with
one folder a card (``<package>/<name>/card.yaml``; ``_`` in a folder's name reads as ``-``), the group
``simrender.policies`` names policy classes. Wherever a name works, the path of a card file does too.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from simrender.cards import Document
from simrender.errors import CardError, UnknownNameError, UsageError

Kind = Literal["machine", "workload"]

CARD_ENDINGS: Final = (".yaml", ".yml", "")
"""Endings of card files; a pipe has none."""


@dataclass(frozen=True)
class CardFile:
    """A card found by name or path; its other files lie in the same folder."""

    name: str
    path: Path

    def document(self) -> Document:
        """Read and parse the file.

        Raises
        ------
        CardError
            If it cannot be read, or is not a YAML mapping.

        """
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "is not a text file"
            raise CardError([f"{self.path}: cannot read this card: {reason}"]) from None
        return Document(text, str(self.path))


def cards(kind: Kind) -> dict[str, CardFile]:
    """Return every installed card of a kind by name, sorted.

    A package that cannot be imported, for whatever reason, is skipped with a warning: someone else's broken plug-in
    must not take the program down.

    Raises
    ------
    UsageError
        If two packages bring a card of the same name.

    """
    found: dict[str, CardFile] = {}
    for entry in importlib.metadata.entry_points(group=f"simrender.{kind}s"):
        try:
            folders = importlib.import_module(entry.value).__path__
        except Exception as error:
            warnings.warn(f"{kind}s of {entry.value!r} are left out: {_reason(error)}", stacklevel=2)
            continue
        for folder in folders:
            for path in sorted(Path(folder).glob("*/card.yaml")):
                name = path.parent.name.replace("_", "-")
                if name in found and found[name].path != path:
                    raise UsageError(f"two {kind}s are called {name!r}: {found[name].path} and {path}")
                found[name] = CardFile(name, path)
    return dict(sorted(found.items()))


def find_card(kind: Kind, name: str) -> CardFile:
    """Return the card of that name, or the card at that path.

    Raises
    ------
    UnknownNameError
        If there is neither, with the nearest name.
    UsageError
        If the path is that of something else than a card.

    """
    if looks_like_a_path(name):
        path = Path(name)
        if path.is_dir():
            raise UsageError(f"{name}: this is a folder, expected the card of a {kind}, such as {path / 'card.yaml'}")
        if path.suffix.lower() not in CARD_ENDINGS:
            mesh = "; a mesh ends in .ply, .obj, .glb, .gltf or .stl" if kind == "workload" else ""
            raise UsageError(f"{name}: expected the card of a {kind}, a file that ends in .yaml or .yml{mesh}")
        if not path.is_file():
            raise UnknownNameError(kind, name, cards(kind), "there is no such file either")
        return CardFile(path.stem if path.stem != "card" else path.resolve().parent.name, path)
    known = cards(kind)
    if name not in known:
        other: Kind = "workload" if kind == "machine" else "machine"
        hint = f"{name!r} is a {other}; the machine comes first, then the workload" if name in cards(other) else ""
        raise UnknownNameError(kind, name, known, hint)
    return known[name]


def looks_like_a_path(name: str) -> bool:
    """Tell whether the user means a file: it has a folder or a file ending, or it is there."""
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).is_file()


def policies() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points of all installed policies by name, sorted; none is imported yet."""
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for entry in importlib.metadata.entry_points(group="simrender.policies"):
        if entry.name in found and found[entry.name].value != entry.value:
            raise UsageError(f"two policies are called {entry.name!r}: {found[entry.name].value} and {entry.value}")
        found[entry.name] = entry
    return dict(sorted(found.items()))


def find_policy(name: str) -> type[Any]:
    """Return the policy class of that name.

    Raises
    ------
    UnknownNameError
        If there is none, with the nearest name.
    UsageError
        If somebody's package brings one that cannot be imported.

    """
    known = policies()
    if name not in known:
        raise UnknownNameError("policy", name, known)
    try:
        policy: type[Any] = known[name].load()
    except Exception as error:
        raise UsageError(f"the policy {name!r} ({known[name].value}) cannot be loaded: {_reason(error)}") from None
    return policy


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def load_function(reference: str, where: str) -> Callable[..., Any]:
    """Return the function that ``"package.module:function"`` names.

    Raises
    ------
    CardError
        If there is no such module or function; ``where`` says which card asked for it.

    """
    module, _, name = reference.partition(":")
    try:
        function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise CardError([f"{where}: cannot load {reference!r} (written as package.module:function): {error}"]) from None
    return function
