"""Spans: who did what, when. The event log of a simulation and what can be read from it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from simrender.clock import TICKS_PER_SECOND

if TYPE_CHECKING:
    import pandas as pd

KERNELS: Final = ("generate", "trace", "shade", "tonemap", "assemble")
"""Spans during which a GPU computes."""

COPIES: Final = ("copy", "merge")
"""Spans during which a GPU sends: ray queues, and finished pixels."""

PHASES: Final = ("load", "sync")
"""Spans during which a rank waits for its data, or for other ranks in a collective."""

KINDS: Final = KERNELS + COPIES + PHASES


@dataclass
class Timeline:
    """Everything that took time, in the order in which it was settled.

    Attributes
    ----------
    gpus : int
        How many processors there are rows for.
    names : list of str
        Theirs; ``gpu0``, ``gpu1`` ... unless given.
    device, kind, start, end : list of int
        Index of the GPU, index into `KINDS`, and the ticks.
    nbytes, rays : list of float
        What a span moved or worked on, at published size.

    """

    gpus: int
    names: list[str] = field(default_factory=list)
    device: list[int] = field(default_factory=list)
    kind: list[int] = field(default_factory=list)
    start: list[int] = field(default_factory=list)
    end: list[int] = field(default_factory=list)
    nbytes: list[float] = field(default_factory=list)
    rays: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.names = self.names or [f"gpu{i}" for i in range(self.gpus)]

    def add(self, device: int, kind: int, start: int, end: int, nbytes: float, rays: float) -> None:
        """Log a span."""
        self.device.append(device)
        self.kind.append(kind)
        self.start.append(start)
        self.end.append(end)
        self.nbytes.append(nbytes)
        self.rays.append(rays)

    def __len__(self) -> int:
        return len(self.device)

    def sha256(self) -> str:
        """Return the hash of the log: equal for equal simulations, down to the picosecond and the order of events."""
        digest = hashlib.sha256(repr((KERNELS, COPIES, self.gpus)).encode())
        for ticks in (self.device, self.kind, self.start, self.end):
            digest.update(np.array(ticks, dtype="<i8").tobytes())
        for amounts in (self.nbytes, self.rays):
            digest.update(np.array(amounts, dtype="<f8").tobytes())
        return digest.hexdigest()

    def frame(self) -> pd.DataFrame:
        """Return the spans as a table: device, kind, start_s, end_s, bytes, rays; sorted by start, then device."""
        import pandas as pd

        names = np.array(KINDS)
        table = pd.DataFrame(
            {
                "device": [self.names[d] for d in self.device],
                "kind": names[np.array(self.kind, dtype=int)] if self.kind else [],
                "start_s": np.array(self.start, dtype=float) / TICKS_PER_SECOND,
                "end_s": np.array(self.end, dtype=float) / TICKS_PER_SECOND,
                "bytes": np.array(self.nbytes, dtype=float),
                "rays": np.array(self.rays, dtype=float),
            }
        )
        order = np.lexsort((np.array(self.device), np.array(self.start)))
        return table.iloc[order].reset_index(drop=True)

    def busy_share(self, end: int, parts: int = 100) -> NDArray[np.float64]:
        """Return the share of the processors that run kernels, in each of equal parts of the time until a tick.

        Parameters
        ----------
        end : int
        parts : int

        Returns
        -------
        float64 array (parts,)

        """
        kernel = np.array(self.kind, dtype=int) < len(KERNELS)
        edges = np.linspace(0.0, float(end), parts + 1)

        def since(ticks: list[int]) -> NDArray[np.float64]:
            moments = np.sort(np.array(ticks, dtype=float)[kernel])
            passed = np.searchsorted(moments, edges)
            before: NDArray[np.float64] = np.concatenate([[0.0], np.cumsum(moments)])[passed]
            gone: NDArray[np.float64] = passed * edges - before
            return gone

        busy: NDArray[np.float64] = np.diff(since(self.start) - since(self.end))
        share: NDArray[np.float64] = np.clip(busy / max(self.gpus * float(end) / parts, 1.0), 0.0, 1.0)
        return share

    def seconds_by_kind(self) -> dict[str, list[float]]:
        """Return, for each kind of span, the seconds that each GPU spent on it."""
        device, kind = np.array(self.device, dtype=int), np.array(self.kind, dtype=int)
        seconds = (np.array(self.end, dtype=float) - np.array(self.start, dtype=float)) / TICKS_PER_SECOND
        return {
            name: np.bincount(device[kind == k], seconds[kind == k], minlength=self.gpus).tolist()
            for k, name in enumerate(KINDS)
        }
