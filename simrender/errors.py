"""The exceptions of simrender.

Everything a user can cause derives from `SimrenderError`; the command line prints its message alone, without a
traceback, and exits with status 2. Anything else that escapes is a defect of simrender.

    SimrenderError
    ├── UnitError            a quantity that cannot be read, or has the wrong dimension
    ├── CardError            one or more mistakes in a card or in a `--set`, all reported together
    ├── UnknownNameError     no machine, workload or policy of that name (says what is near)
    ├── SceneError           a mesh or scene that cannot be rendered
    ├── UsageError           options that contradict each other, the machine or the file system
    ├── UnreachableError     a transfer between two nodes that no route connects
    ├── LinkFailedError      a transfer over a link that is down
    ├── ScheduleError        a policy used a device in a way it does not allow
    └── InvariantError       a policy lost or repeated a ray: a defect of that policy
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SimrenderError(Exception):
    """Base of all errors that simrender raises on purpose."""


class UnitError(SimrenderError):
    """A quantity such as ``"12.5 GB/s"`` that cannot be read, or that measures something else than was asked for."""


class CardError(SimrenderError):
    """Every mistake found in one card, one a line, each as ``file:line:column: path: message``.

    Parameters
    ----------
    mistakes : iterable of str
        The formatted mistakes, in the order of the file.

    """

    def __init__(self, mistakes: Iterable[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(self.mistakes))


class UnknownNameError(SimrenderError):
    """No machine, workload or policy is known by the given name."""

    def __init__(self, kind: str, name: str, known: Iterable[str], hint: str = "") -> None:
        known = sorted(known)
        message = f"unknown {kind} {name!r}{did_you_mean(name, known)} (known: {', '.join(known) or 'none'})"
        super().__init__(f"{message}; {hint}" if hint else message)


class SceneError(SimrenderError):
    """A mesh file or scene that cannot be read or rendered."""


class SceneWarning(UserWarning):
    """A scene that was repaired, or that lies outside the range where its rays are exact."""


class UsageError(SimrenderError):
    """Options that contradict each other, the chosen machine, or the file system."""


class UnreachableError(SimrenderError):
    """A transfer was asked for between two nodes that no route connects."""


class LinkFailedError(SimrenderError):
    """A transfer was under way over a link, or reached one, that is down."""


class ScheduleError(SimrenderError):
    """A policy asked a device for something it does not do: a negative time, more memory than there is."""


class InvariantError(SimrenderError):
    """A policy broke what every policy must keep, for instance that each ray is retired exactly once."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known word, or an empty string when nothing is near."""
    known = list(known)
    # Letters in the wrong case are the commonest slip with units ("mb", "GIB"), so they count as nearest.
    near = [k for k in known if k.lower() == word.lower()] or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else ""
