"""Ray queue cycling: trace every ray on every GPU of its island.

Wald, Jaros and Zellmann, "Data parallel multi-GPU path tracing using ray queue cycling", 2023.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from simrender.policies.frame import RayQueue, Steps
from simrender.policies.rank import ACCUMULATED_BYTES, PIXEL_BYTES, Rank
from simrender.rays.partition import Method

SPLIT_SHARE = 1 / 64
"""Objects with more than this share of all triangles are big; the paper does not state its threshold."""


@dataclass(frozen=True)
class RayQueueCycling:
    """Ray queue cycling, complete with wavefront merging and a choice of copies.

    Parameters
    ----------
    copy : "explicit" or "implicit"
        A copy engine moves each queue after its trace kernel, or the trace kernel itself reads the neighbour's queue
        (section 4.6). The paper's default is explicit.
    merging : bool
        Start the next sample's wave as soon as the queues have room for it (section 4.10). Room is counted more
        strictly than there: the queues must also hold what the rays may become in the next shade step, or rays would
        be lost.
    slots : int
        Queue slots a pixel: two are what a path can fill, a third makes room for merging (sections 4.3 and 4.10).
    ray_bytes : float
        Size of a ray, with its full hit information (section 4.3).
    partition : "heaviest_first" or "round_robin"
        How objects are dealt to the GPUs of an island (section 4.1).
    split_share : float
        Objects with more than this share of all triangles are split (section 4.1, big-object splitting; the paper does
        not state its threshold).

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    copy: Literal["explicit", "implicit"] = "explicit"
    merging: bool = True
    slots: Annotated[int, Field(ge=2)] = 3
    ray_bytes: Annotated[float, Field(gt=0)] = 88.0
    partition: Method = "heaviest_first"
    split_share: Annotated[float, Field(gt=0, le=1)] = SPLIT_SHARE

    replicated: ClassVar[bool] = False

    @property
    def kernels_read(self) -> bool:
        """Whether trace kernels read their neighbour's queue."""
        return self.copy == "implicit"

    @property
    def first_domain(self) -> int:
        """A queue is traced at home first, or, where kernels read their neighbour's queue, one rank further."""
        return 0 if self.copy == "explicit" else 1

    def buffer_bytes(self, pixels: float) -> dict[str, float]:
        """Return two queues with so many slots a pixel, and the frame buffers (sections 4.3 and 4.8)."""
        return {
            "ray queues": 2 * self.slots * pixels * self.ray_bytes,
            "frame buffers": pixels * (ACCUMULATED_BYTES + PIXEL_BYTES),
        }

    def rank(self, me: Rank) -> Steps:
        """Render one frame (section 4.9)."""
        rays = me.no_rays()
        for sample in range(me.samples):
            rays = yield from me.generate(sample, behind=rays)
            last = sample == me.samples - 1
            while True:
                rays = yield from self.distributed_trace(me, rays)
                rays = yield from me.shade(rays)
                active = yield from me.read_counters(rays)
                if not active.any() or (self.merging and not last and active.room_for_a_wave(self.slots)):
                    break
        yield from me.merge_frame()

    def distributed_trace(self, me: Rank, rays: RayQueue) -> Steps:
        """Trace and cycle, once for each GPU of the island; then each ray is home and has seen every domain."""
        for _ in range(me.island_size):
            if self.copy == "implicit":
                rays = yield from me.trace_shifted(rays, me.right)
            else:
                rays = yield from me.trace(rays)
                rays = yield from me.shift(rays, me.right)
        return rays
