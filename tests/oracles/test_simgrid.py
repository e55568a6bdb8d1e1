"""The network against SimGrid, which nobody here wrote."""

from typing import NamedTuple

import pytest
import simpy

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.hardware.network import Link, Network
from tests.flows import finishes

SECOND = TICKS_PER_SECOND


class Star(NamedTuple):
    """Hosts around a switch, each with its own link up and down of 1 us latency, and what SimGrid made of it."""

    up: tuple[float, ...]
    down: tuple[float, ...]
    flows: tuple[tuple[int, int, float, float, float], ...]


# SimGrid 3.32, fluid model: CM02 with full updates, all factors 1, no TCP window, no cross traffic.
TWO_SPEEDS = Star(
    up=(25000000000.0, 6250000000.0, 25000000000.0, 6250000000.0),
    down=(25000000000.0, 6250000000.0, 25000000000.0, 6250000000.0),
    flows=(  # source, target, bytes, start in s, finish in s
        (3, 2, 24684, 0.002071683903266679, 0.0020776333432666787),
        (3, 1, 480010, 0.0, 0.0001027896),
        (1, 2, 77442237, 0.004141456214345396, 0.016534214134345398),
        (2, 0, 28473, 0.001234251699000624, 0.001237390619000624),
        (2, 3, 19635, 0.0, 1.14248e-05),
        (0, 1, 14341, 0.0017895008135975605, 0.0017937953735975606),
        (3, 0, 149925, 0.0, 4.9976e-05),
        (0, 3, 752196, 0.0, 0.00013765088),
        (1, 0, 6775224, 0.0, 0.00109819376),
        (1, 3, 75987, 0.0, 2.945744e-05),
        (0, 2, 918583, 0.0, 4.5891253333333333e-05),
        (2, 1, 99646347, 0.0028725625912196834, 0.018817978111219685),
    ),
)
TWELVE_SPEEDS = Star(
    up=(
        1330.9621157850095,
        38392.29529170724,
        207987501.65393248,
        16443029.289002826,
        793152598889.7007,
        5182264648.937978,
    ),
    down=(
        39761.238103127784,
        13719031052.655348,
        1271905134.0941947,
        417370848.9586714,
        8622446876.17564,
        639928921.2232691,
    ),
    flows=(  # source, target, bytes, start in s, finish in s
        (2, 3, 284498293, 0.0, 4.103620501078347),
        (1, 5, 6860, 0.0, 0.24070133641076322),
        (2, 5, 372624192, 0.00030039516423671365, 4.951336229368047),
        (1, 0, 1624, 0.0, 0.19761530896433901),
        (3, 5, 21031, 0.0, 0.0013167968235658991),
        (0, 3, 6237, 0.0, 10.550858492671916),
        (2, 0, 37720, 0.002931523423866532, 2.923717393510126),
        (3, 1, 584, 0.0, 7.303313990817762e-05),
        (1, 3, 209, 0.0, 0.020089018457845855),
        (3, 4, 7828, 0.002165005552346156, 0.0026437376733609162),
        (5, 3, 2026218, 0.0, 0.005854005357717211),
        (3, 0, 1443, 0.0011574496401384798, 0.17866283005964878),
        (5, 0, 267109, 0.0024570246372753062, 9.42878810257493),
        (5, 4, 10, 0.003010463037053605, 0.003012467174226022),
        (0, 4, 28, 0.0034947727266854, 0.08764642557682811),
        (0, 1, 46066, 0.0016602419732180307, 40.47748769329094),
        (0, 5, 1543, 0.002190281871306589, 3.501164900827688),
        (4, 5, 127, 0.0, 2.201046515453871e-06),
        (4, 0, 66973, 0.004405659203757697, 4.395895973931697),
        (5, 2, 31470, 0.002319370679229894, 0.002346113090559503),
        (4, 3, 51, 0.002888569755997072, 0.002890862832798929),
        (2, 4, 434411247, 0.0, 5.24825703128669),
        (5, 1, 50934667, 0.002255602649616954, 0.012333863577490101),
        (1, 4, 548, 0.002375596432147024, 0.044359777638680264),
        (3, 2, 13, 0.003482980640976806, 0.0034857717332822703),
    ),
)


@pytest.mark.parametrize("star", [TWO_SPEEDS, TWELVE_SPEEDS], ids=["two speeds", "twelve speeds"])
@pytest.mark.parametrize("together", [False, True], ids=["one by one", "in a batch"])
def test_it_agrees_with_simgrid(star, together):
    hosts = range(len(star.up))
    links = {("up", i): Link(star.up[i], 1e-6) for i in hosts} | {("down", i): Link(star.down[i], 1e-6) for i in hosts}
    routes = {(i, j): [("up", i), ("down", j)] for i in hosts for j in hosts if i != j}
    sources, targets, sizes, starts, _ = zip(*star.flows, strict=True)
    begins = [to_ticks(start) for start in starts]
    if together:
        arrived = {}
        net = Network(simpy.Environment(), links, routes)
        net.post(
            sources, targets, sizes, begins, lambda keys, tick: arrived.update(dict.fromkeys(keys.tolist(), tick)),
            range(len(sizes)),
        )  # fmt: skip
        net._env.run()
        ticks = [arrived[i] for i in range(len(sizes))]
    else:
        ticks, _ = finishes(links, routes, zip(sources, targets, sizes, begins, strict=True))
    # Rounding up to a picosecond is all that tells them apart.
    assert all(
        abs(tick / SECOND - flow[-1]) < 5e-12 + 1e-14 * flow[-1] for tick, flow in zip(ticks, star.flows, strict=True)
    )
