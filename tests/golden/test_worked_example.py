"""Ray queue cycling on two GPUs, worked out by hand to the picosecond.

Sixteen pixels, one path each, two triangles, no bounces: each GPU generates eight rays, traces them against its own
triangle, passes them on, traces the others', passes them back, shades, and GPU 0 gathers the picture. With a launch
latency of 10 us, 1 Mray/s, 1 GB/s everywhere, a copy latency of 5 us, and a host that takes 1 us to issue a kernel,
2 us to issue a copy and 3 us to read a counter:

- a generate kernel takes 10 + 8 * 88 / 1000 = 10.704 us, a trace kernel 10 + 8 = 18 us, a copy 5.704 us;
- the host issues both generates (at 1 and 2 us), both traces (3 and 4 us), then both copies (6 and 8 us);
- nobody goes on before both copies have arrived.
"""

from __future__ import annotations

import numpy as np
import pytest

from simrender import load_machine, simulate
from simrender.cards import Document
from simrender.policies.ray_queue_cycling import RayQueueCycling
from simrender.rays.scene import Mesh, Scene, SceneObject
from simrender.rays.workload import Workload
from simrender.rays.workload_card import WorkloadCard
from tests.scenes import MATERIALS, placed

CARD = """
title: two triangles
published: {resolution: 4x4, samples: 1, triangles: 2, instances: 2, instanced_triangles: 2}
traced: {resolution: 4x4}
scene: {generator: "none:none"}
camera: {position: [0, -5, 0], look_at: [0, 0, 0]}
bounces: {diffuse: 0, mirror: 0}
"""

ROUND = [
    "gpu.launch_latency=10 us", "gpu.coherent_rate=1 Mray/s", "gpu.rate_primitives=1", "gpu.half_saturation=0 ray",
    "gpu.memory_bandwidth=1 GB/s", "nvlink.bandwidth=1 GB/s", "nvlink.duplex=1", "nvlink.latency=5 us",
    "host.launch_issue=1 us", "host.copy_issue=2 us", "host.readback=3 us",
]  # fmt: skip

EXPECTED = """
gpu0 generate    1.000   11.704
gpu1 generate    2.000   12.704
gpu0 trace      11.704   29.704
gpu1 trace      12.704   30.704
gpu0 copy       29.704   35.408
gpu1 copy       30.704   36.408
gpu0 trace      37.408   55.408
gpu1 trace      38.408   56.408
gpu0 copy       55.408   61.112
gpu1 copy       56.408   62.112
gpu0 shade      63.112   73.944
gpu1 shade      64.112   74.944
gpu0 tonemap    81.944   92.104
gpu1 tonemap    82.944   93.104
gpu1 merge      93.104   98.136
gpu0 assemble   99.136  109.264
"""


@pytest.fixture
def two_triangles(tmp_path):
    mesh = Mesh(np.array([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], np.float32), np.array([[0, 1, 2]]))
    objects = (SceneObject("near", (mesh,)), SceneObject("far", (mesh,)))
    scene = Scene(objects, np.array([0, 1]), placed(np.array([[0, 0, 0], [0, 2, 0]]), np.ones(2)), MATERIALS)
    document = Document(CARD, "two.yaml")
    return Workload("two", document.validate(WorkloadCard), document, tmp_path, tmp_path, scene)


def test_two_gpus_to_the_picosecond(two_triangles):
    result = simulate(load_machine("dgx2", ROUND), two_triangles, RayQueueCycling(), islands=1, gpus=2)
    lines = []
    for span in result.timeline.sort_values(["start_s", "device"]).itertuples():
        start, end = span.start_s * 1e6, span.end_s * 1e6
        lines.append(f"{span.device} {span.kind:<9}{start:8.3f} {end:8.3f}")
    assert lines == EXPECTED.strip().splitlines()
    assert result.frame_time_s == 109_264e-9
    assert result.counts["traced_ray_domain_tests"] == 32
    assert result.counts["network_bytes"] == 4 * 8 * 88 + 8 * 4


def test_implicit_copy_hides_the_shorter_of_tracing_and_reading(two_triangles):
    explicit, implicit = (
        simulate(
            load_machine("dgx2", [*ROUND, "nvlink.kernel_share=1"]),
            two_triangles,
            RayQueueCycling(copy=copy),
            islands=1,
            gpus=2,
        )
        for copy in ("explicit", "implicit")
    )
    # Copies of 5.704 us vanish behind kernels of 18 us; but GPU 0 waits for GPU 1 to have generated what it reads.
    # Traces run from 13.704 and 14.704 us and from 33.704 and 34.704 us; the rest follows as above from 52.704 us on.
    assert implicit.frame_time_s == 99_856e-9
    assert implicit.counts["network_bytes"] == explicit.counts["network_bytes"]
