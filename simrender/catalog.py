"""Names to machines, workloads and policies.

Content lives outside simrender and is found through entry points, so that a third party's machines, scenes and
schedulers plug in like our own: the groups ``simrender.machines`` and ``simrender.workloads`` name Python packages with
one folder a card (``<package>/<name>/card.yaml``; ``_`` in a folder's name reads as ``-``), the group
``simrender.policies`` names policy classes. Wherever a name works, the path of a card file does too, and either may
name one of the card's variants: ``frontera-rtx:fdr``, ``my/card.yaml:fdr``.

A card that begins with ``extends: NAME`` says only what differs from another one.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from simrender.cards import Document
from simrender.errors import CardError, UnknownNameError, UsageError

Kind = Literal["machine", "workload"]

SCENE_ENDINGS: Final = (
    ".ply", ".obj", ".glb", ".gltf", ".stl", ".spray", ".npy", ".nrrd", ".nhdr", ".raw", ".vti", ".vtr", ".vtu", ".vtk",
)  # fmt: skip
"""Of the files of `simrender.rays.files`, for messages."""

CARD_ENDINGS: Final = (".yaml", ".yml", "")
"""Endings of card files; a pipe has none."""


_SECTIONS: Final[dict[Kind, tuple[str, ...]]] = {
    "machine": ("nodes", "gpus", "gpu", "cpu", "host", "nvlink", "pcie", "network"),
    "workload": ("published", "traced", "scene", "camera", "bounces", "integrator", "domains", "policy"),
}
"""Fields by which the card of a machine is told from that of a workload."""


@dataclass(frozen=True)
class CardFile:
    """A card found by name or path; its other files lie in the same folder.

    Attributes
    ----------
    base : str
        Its name, without that of a variant.
    path : Path
    kind : "machine" or "workload", optional
        None if it is not known yet.
    variant : str, optional

    """

    base: str
    path: Path
    kind: Kind | None = None
    variant: str | None = None

    @property
    def name(self) -> str:
        """Its name as a person gives it: ``frontera-rtx:fdr``."""
        return self.base if self.variant is None else f"{self.base}:{self.variant}"

    def document(self) -> Document:
        """Read and parse the file and those it extends.

        Returns
        -------
        Document
            The fields of the card, or of the variant asked for, over those of the cards it extends.

        Raises
        ------
        CardError
            If one of them cannot be read or is not a YAML mapping, or extends a card that is none.
        UnknownNameError
            If the card has no such variant.

        """
        return self._chosen(self._merged(()))

    def _chosen(self, document: Document) -> Document:
        """Return the variant of a card that is asked for, or the card with all of them."""
        document.split_variants()
        if self.variant is None:
            return document
        if self.variant not in document.variants:
            document.check()  # it may be there, with a mistake
            raise UnknownNameError(f"variant of {self.base}", self.variant, document.variants)
        return document.variants[self.variant]

    def _merged(self, children: tuple[CardFile, ...]) -> Document:
        """Return the card over those it extends, with its variants still in place.

        Parameters
        ----------
        children : tuple of CardFile
            The cards that extend this one, the nearest last.

        """
        document = self._parsed()
        if "extends" not in document.data:
            return document
        at, reference = document.position(("extends",)), document.take("extends")
        try:
            parent = self._parent(reference, self.kind or kind_of(document.data), (*children, self))
            lower = parent._merged((*children, self))
            parent._check_kind(lower)
            if parent.variant is not None:
                lower = parent._chosen(lower)
        except (UnknownNameError, UsageError) as error:
            raise CardError([f"{at}: extends: {error}"]) from None
        _reach_meshes(lower.data, parent.path.resolve().parent)
        merged = document.over(lower)
        if "title" not in document.data and isinstance(title := lower.data.get("title"), str):
            merged.data["title"] = f"{title}, as changed by {self.base}"
        return merged

    def _parsed(self) -> Document:
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "is not a text file"
            raise CardError([f"{self.path}: cannot read this card: {reason}"]) from None
        return Document(text, str(self.path), self.base)

    def _parent(self, reference: Any, kind: Kind | None, children: tuple[CardFile, ...]) -> CardFile:
        """Return the card that this one extends."""
        if not isinstance(reference, str):
            got = "nothing" if reference is None else repr(reference)
            raise UsageError(f"expected the name or the path of a card, got {got}")
        base, _ = _split(reference, self.path.parent)
        if kind and not looks_like_a_path(base, self.path.parent) and base not in cards(kind):
            for other in _SECTIONS:
                if other != kind and base in cards(other):
                    raise UsageError(f"{base!r} is a {other}, expected a {kind}")
        parent = find_card(kind, reference, self.path.parent)
        places = [child.path.resolve() for child in children]
        if parent.path.resolve() in places:
            names = [child.base for child in children[places.index(parent.path.resolve()) :]]
            raise UsageError(f"the cards extend one another in a circle: {' extends '.join([*names, parent.base])}")
        return parent

    def _check_kind(self, document: Document) -> None:
        found = kind_of(document.data)
        if self.kind and found and found != self.kind:
            raise UsageError(f"{self.path} is the card of a {found}, expected that of a {self.kind}")


def _reach_meshes(card: dict[str, Any], folder: Path) -> None:
    """Let a card in another folder find the meshes that lie beside this one, also those of its variants."""
    variants = card.get("variants")
    for fields in (card, *(variants.values() if isinstance(variants, dict) else ())):
        scene = fields.get("scene") if isinstance(fields, dict) else None
        if isinstance(scene, dict) and isinstance(scene.get("file"), str):
            scene["file"] = str(folder / scene["file"])


def kind_of(fields: Mapping[str, Any]) -> Kind | None:
    """Tell the card of a machine from that of a workload by its fields; None if they are those of both or neither."""
    kinds = [kind for kind, sections in _SECTIONS.items() if any(section in fields for section in sections)]
    return kinds[0] if len(kinds) == 1 else None


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
                found[name] = CardFile(name, path, kind)
    return dict(sorted(found.items()))


def find_card(kind: Kind | None, name: str, folder: Path | None = None) -> CardFile:
    """Return the card of that name, or the card at that path; ``:VARIANT`` after either chooses one of its variants.

    Parameters
    ----------
    kind : "machine" or "workload", optional
        None takes a card of either kind.
    name : str
    folder : Path, optional
        Where a relative path begins; by default the working folder.

    Raises
    ------
    UnknownNameError
        If there is neither, with the nearest name.
    UsageError
        If the path is that of something else than a card.

    """
    folder, what = folder or Path(), kind or "machine or workload"
    base, variant = _split(name, folder)
    known = cards(kind) if kind else {**cards("workload"), **cards("machine")}
    if looks_like_a_path(base, folder):
        path = folder / base
        if path.is_dir():
            raise UsageError(f"{base}: this is a folder, expected the card of a {what}, such as {path / 'card.yaml'}")
        if path.suffix.lower() not in CARD_ENDINGS:
            scene = f"; a scene ends in {', '.join(SCENE_ENDINGS)}" if kind == "workload" else ""
            raise UsageError(f"{base}: expected the card of a {what}, a file that ends in .yaml or .yml{scene}")
        if not path.is_file():
            raise UnknownNameError(what, base, known, "there is no such file either")
        return CardFile(path.stem if path.stem != "card" else path.resolve().parent.name, path, kind, variant)
    if base not in known:
        other: Kind = "workload" if kind == "machine" else "machine"
        hint = f"{base!r} is a {other}; the machine comes first, then the workload" if base in cards(other) else ""
        raise UnknownNameError(what, base, known, hint)
    return dataclasses.replace(known[base], variant=variant)


def _split(name: str, folder: Path) -> tuple[str, str | None]:
    """Split ``NAME:VARIANT``; a file may have a colon in its name, and a folder above it too."""
    base, colon, variant = name.rpartition(":")
    if not colon or not base or "/" in variant or "\\" in variant or (folder / name).is_file():
        return name, None
    return base, variant


def looks_like_a_path(name: str, folder: Path | None = None) -> bool:
    """Tell whether the user means a file: it has a folder or a file ending, or it is there."""
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(folder or "", name).is_file()


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
