"""Image parallelism: every rank holds the whole model and renders its own scan lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field

from simrender.policies.frame import Steps
from simrender.policies.rank import ACCUMULATED_BYTES, PIXEL_BYTES, Rank
from simrender.rays.partition import Method


@dataclass(frozen=True)
class ImageParallel:
    """Replicated data, interleaved scan lines, a wavefront path tracer on each GPU.

    The N = 1 end of the islands paper's spectrum (section 3); rank i takes scan lines i, i + R, i + 2R ... Ranks meet
    only when the finished pixels are merged on rank 0.

    Parameters
    ----------
    ray_bytes : float
        Size of a ray in a queue. 88 B is that of the ray queue cycling paper (section 4.3), kept here so that the two
        policies compare like with like.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    ray_bytes: Annotated[float, Field(gt=0)] = 88.0

    replicated: ClassVar[bool] = True
    kernels_read: ClassVar[bool] = False
    slots: ClassVar[int] = 2
    partition: ClassVar[Method] = "heaviest_first"
    split_share: ClassVar[float] = 1.0
    first_domain: ClassVar[int] = 0

    def buffer_bytes(self, pixels: float) -> dict[str, float]:
        """Return two queues of two rays a pixel, and the frame buffers."""
        return {
            "ray queues": 2 * self.slots * pixels * self.ray_bytes,
            "frame buffers": pixels * (ACCUMULATED_BYTES + PIXEL_BYTES),
        }

    def rank(self, me: Rank) -> Steps:
        """Render this rank's scan lines, a path a pixel at a time."""
        for sample in range(me.samples):
            rays = yield from me.generate(sample, behind=me.no_rays())
            while True:
                rays = yield from me.trace(rays)
                rays = yield from me.shade(rays)
                if (yield from me.read_own_counter(rays)) == 0:
                    break
        yield from me.merge_frame()
