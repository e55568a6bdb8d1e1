"""The timeline as a Chrome trace, which Perfetto opens: one process a GPU, a track for kernels and one for copies.

Only complete events (``X``) on numbered tracks are used; on one track they never overlap. One more process has a
counter (``C``) for the load of each link that carried something, in GB/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from simrender.timeline import COPIES, KERNELS

if TYPE_CHECKING:
    from simrender.result import Result

_TICKS_PER_MICROSECOND = 1e6
_MOST_LINKS = 64
"""Of a large machine only the busiest links are shown: a million counter events are too much for a browser."""


def chrome_trace(result: Result) -> dict[str, Any]:
    """Return the trace as the JSON object format: times in microseconds, bytes and rays as arguments."""
    events: list[dict[str, Any]] = []
    log = result.spans
    if log is None:
        return {"traceEvents": events}
    for gpu in range(log.gpus):
        events.append(_name("process_name", gpu, 0, log.names[gpu]))
        events.append({"ph": "M", "name": "process_sort_index", "pid": gpu, "tid": 0, "args": {"sort_index": gpu}})
        events.append(_name("thread_name", gpu, 1, "kernels"))
        events.append(_name("thread_name", gpu, 2, "copies"))
    names = KERNELS + COPIES
    rows = zip(log.device, log.kind, log.start, log.end, log.nbytes, log.rays, strict=True)
    for device, kind, start, end, nbytes, rays in rows:
        events.append(
            {
                "ph": "X",
                "name": names[kind],
                "cat": "kernel" if kind < len(KERNELS) else "copy",
                "pid": device,
                "tid": 1 if kind < len(KERNELS) else 2,
                "ts": start / _TICKS_PER_MICROSECOND,
                "dur": (end - start) / _TICKS_PER_MICROSECOND,
                "args": {"bytes": nbytes, "rays": rays},
            }
        )
    events += _counters(result, log.gpus)
    facts = {k: str(getattr(result, k)) for k in ("machine", "workload", "policy", "islands", "event_log_sha256")}
    return {"traceEvents": events, "displayTimeUnit": "ms", "otherData": facts}


def _counters(result: Result, pid: int) -> list[dict[str, Any]]:
    """Return the loads of the busiest links, as counters of one process."""
    if not result.loads:
        return []
    events = [
        _name("process_name", pid, 0, "links"),
        {"ph": "M", "name": "process_sort_index", "pid": pid, "tid": 0, "args": {"sort_index": pid}},
    ]
    busiest = sorted(result.loads, key=lambda name: -result.links[name]["mean_utilization"])[:_MOST_LINKS]
    for name in sorted(busiest, key=list(result.loads).index):
        ticks, loads = result.loads[name]
        rows = zip((ticks / _TICKS_PER_MICROSECOND).tolist(), (loads / 1e9).tolist(), strict=True)
        events += [{"ph": "C", "name": name, "pid": pid, "ts": ts, "args": {"GB/s": load}} for ts, load in rows]
    return events


def _name(what: str, pid: int, tid: int, name: str) -> dict[str, Any]:
    return {"ph": "M", "name": what, "pid": pid, "tid": tid, "args": {"name": name}}
