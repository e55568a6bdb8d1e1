"""What the runtime refuses: policies that lose, repeat or mix up rays."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from simrender import simulate
from simrender.errors import InvariantError
from simrender.policies.frame import Counts
from simrender.policies.ray_queue_cycling import RayQueueCycling
from tests.scenes import garden_workload


@dataclass(frozen=True)
class DropsASample(RayQueueCycling):
    def rank(self, me):
        me.samples -= 1
        yield from super().rank(me)


@dataclass(frozen=True)
class StopsEarly(RayQueueCycling):
    def rank(self, me):
        rays = yield from me.generate(0, behind=me.no_rays())
        rays = yield from me.trace(rays)
        rays = yield from me.shift(rays, me.right)
        yield from me.shade(rays)


@dataclass(frozen=True)
class ForgetsADomain(RayQueueCycling):
    def distributed_trace(self, me, rays):
        for _ in range(me.island_size):
            rays = yield from me.shift(rays, me.right)
        return rays


@dataclass(frozen=True)
class RepeatsASample(RayQueueCycling):
    def rank(self, me):
        rays = yield from me.generate(0, behind=me.no_rays())
        rays = yield from self.distributed_trace(me, rays)
        yield from me.shade(rays)
        yield from super().rank(me)


@dataclass(frozen=True)
class MergesWithoutRoom(RayQueueCycling):
    def rank(self, me):
        rays = me.no_rays()
        for sample in range(me.samples):
            rays = yield from me.generate(sample, behind=rays)
            rays = yield from self.distributed_trace(me, rays)
            rays = yield from me.shade(rays)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (MergesWithoutRoom(slots=2), r"rank \d has \d+ rays for \d+ queue slots"),
        (DropsASample(), r"of \d+ rays \d+ were never retired and 0 more than once"),
        (StopsEarly(), r"rank \d shades rays that saw 1 of 2 domains"),
        (ForgetsADomain(), r"rank \d shades rays that saw 0 of 2 domains"),
        (RepeatsASample(), r"0 were never retired and \d+ more than once"),
    ],
)
def test_a_broken_policy_is_found_out(policy, message, tmp_path):
    with pytest.raises(InvariantError, match=message):
        simulate("desktop-rtx8000", garden_workload(cache=tmp_path), policy, islands=1)


def test_room_for_a_wave_counts_what_rays_may_become():
    def room(paths, shadows, slots):
        return Counts([paths], [shadows], [100]).room_for_a_wave(slots)

    assert room(50, 100, 3)
    assert not room(51, 0, 3)  # 151 path rays may become 302, of 300 slots
    assert not room(40, 161, 3)  # the rays alone leave no room
    assert not room(1, 0, 2)  # two slots a pixel are for one wave
    assert room(0, 0, 2)
    assert room(100, 0, 4)


def test_every_rank_must_have_room():
    assert not Counts([0, 60], [0, 0], [100, 100]).room_for_a_wave(3)
