"""`simrender network`: collectives, messages and the display, without rendering anything."""

import json
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.cli import main
from simrender.hardware.machine import load_machine
from simrender.hardware.questions import ask_collective, ask_transfer
from simrender.hardware.schedules import ALGORITHMS, schedule, usable

check = settings(deadline=None, derandomize=True, max_examples=50)

CORES = """\
title: Four nodes
nodes: 4
cpu: {model: C, sockets: 1, cores: 4, memory: 16 GiB, reserved_memory: 1 GiB, memory_bandwidth: 30 GB/s,
  launch_latency: 0 us, core_coherent_rate: 1 Mray/s, core_incoherent_rate: 1 Mray/s, core_parse_bandwidth: 100 MB/s,
  core_build_rate: 1 Mtri/s, rate_primitives: 1e6, half_saturation: 100 ray, bvh_triangle_bytes: 70 B,
  bvh_instance_bytes: 400 B}
network:
  technology: wire
  bandwidth: 1 GB/s
  latency: {value: 2 us, source: "a guess, for this test", status: assumed}
mpi: {flavour: mpich, overhead: 1 us, eager: 16 KiB}
"""

DISPLAY = """\
display: {bandwidth: 1868 MiB/s, packet: 2 KiB, pixel_bytes: 7 B, tile_pixel_bytes: 3 B, tile_header: 8 B,
  ray_packet: 64, packets_per_message: 13, copy_threads: 3, frames_in_flight: 2, nodes: 1, latency: 2 us,
  copy_bandwidth: {value: 798.336 MB/s, source: "55 frames/s with one thread", status: calibrated}}
"""

GPUS = """\
gpus: 2
gpu: {model: G, ray_tracing_cores: true, memory: 16 GiB, reserved_memory: 1 GiB, launch_latency: 5 us,
  memory_bandwidth: {value: 300 GB/s, source: "a guess, for this test", status: assumed},
  coherent_rate: 600 Mray/s, incoherent_rate: 100 Mray/s, rate_primitives: 1e9, half_saturation: 3600 ray,
  bvh_triangle_bytes: 50 B, bvh_instance_bytes: 400 B}
pcie: {bandwidth: 10 GB/s, duplex: 1, latency: 3 us, kernel_share: 0.5}
host: {launch_issue: 2 us, copy_issue: 2 us, readback: 10 us, to_device: 8 GB/s, from_device: 8 GB/s}
"""


@pytest.fixture
def card(tmp_path):
    """The path of a card of four nodes on one switch, 1 GB/s and 2 us apart."""
    path = tmp_path / "four.yaml"
    path.write_text(CORES + DISPLAY)
    return path


@pytest.fixture
def gpus(tmp_path):
    """The path of the same card with two GPUs in each node."""
    path = tmp_path / "eight.yaml"
    path.write_text(CORES + GPUS)
    return path


@pytest.fixture
def ask(run_cli):
    """Ask for JSON on stdout and return it."""

    def run(*arguments):
        ran = run_cli("network", *arguments, "--json", "-")
        assert ran.code == 0, ran
        assert re.fullmatch(r"simulated in [0-9.]+ s\n", ran.err)
        return json.loads(ran.out)

    return run


# Times, by hand


def test_a_message_takes_overhead_latency_and_its_bytes(ask, card):
    (row,) = ask(card, "transfer", "--bytes", "1MB", "--from", 1, "--to", 3)["rows"]
    assert row["time_s"] == pytest.approx(1e-6 + 2e-6 + 1e-3)
    assert row["closed_form_s"] == pytest.approx(row["time_s"])
    assert (row["from"], row["to"], row["ranks"], row["messages"], row["sent_bytes"]) == (1, 3, 2, 1, 1e6)
    assert (row["alpha_s"], row["beta_s_per_byte"], row["gamma_s_per_byte"]) == (3e-6, 1e-9, 0.0)
    assert row["algorithm_bandwidth_bytes_per_s"] == pytest.approx(1e6 / 1.003e-3)


def test_a_ring_on_one_switch_meets_its_closed_form(ask, card):
    (row,) = ask(card, "allgather", "--bytes", "1MB", "--algorithm", "ring")["rows"]
    assert row["time_s"] == pytest.approx(3 * 1.003e-3, rel=1e-9)
    assert row["contention_ratio"] == pytest.approx(1.0)
    assert (row["messages"], row["sent_bytes"]) == (12, 12e6)
    assert row["algorithm_bandwidth_bytes_per_s"] == pytest.approx(4e6 / row["time_s"])
    assert row["busiest_link"] == "node0.nic.out"
    assert row["busiest_link_mean_utilization"] == pytest.approx(3e-3 / row["time_s"])
    assert row["busiest_link_peak_utilization"] == 1.0


def test_two_nodes_share_the_up_link_of_their_leaf_switch(ask, card):
    """Pairwise: one exchange inside the leaf, two across it, where both nodes of a leaf share 1 GB/s."""
    leaf = "machine.network.leaf={nodes: 2, oversubscription: 2, latency: 1 us}"
    (row,) = ask(card, "alltoall", "--bytes", "1MB", "--algorithm", "pairwise", "--set", leaf)["rows"]
    assert row["time_s"] == pytest.approx(1.003e-3 + 2 * 2.004e-3, rel=1e-9)
    assert row["closed_form_s"] == pytest.approx(3 * 1.004e-3, rel=1e-9)
    assert row["alpha_s"] == pytest.approx(4e-6)
    assert row["contention_ratio"] == pytest.approx(5.011 / 3.012)
    assert row["busiest_link"] == "leaf0.up"


def test_a_reduction_pays_for_combining(ask, card):
    """Two operands are read and one is written at 30 GB/s."""
    (row,) = ask(card, "reduce", "--bytes", "1MB", "--ranks", 2, "--algorithm", "binomial")["rows"]
    assert row["gamma_s_per_byte"] == pytest.approx(1e-10)
    assert row["time_s"] == row["closed_form_s"] == pytest.approx(3e-6 + 1e-3 + 1e-4)


def test_a_barrier_sends_no_bytes(ask, card):
    (row,) = ask(card, "barrier")["rows"]
    assert row["time_s"] == pytest.approx(2 * 3e-6)
    assert (row["bytes"], row["messages"], row["sent_bytes"]) == (0.0, 8, 0.0)
    assert row["busiest_link"] is None
    assert row["algorithm_bandwidth_bytes_per_s"] is None


def test_inside_a_node_a_copy_needs_no_mpi(ask):
    answer = ask("dgx2", "transfer", "--bytes", "1GB", "--to", 5)
    (row,) = answer["rows"]
    assert answer["mpi_flavour"] is None
    assert row["time_s"] == pytest.approx(2.5e-6 + 1e9 / 145.57e9)
    assert row["contention_ratio"] == pytest.approx(1.0)
    assert row["staged"] is False


def test_messages_of_gpus_go_straight_or_through_host_memory(ask, gpus):
    across = (gpus, "transfer", "--to", 2, "--bytes", "1MB")
    direct = ask(*across, "--set", "machine.network.gpu_direct=true")["rows"][0]
    staged = ask(*across)["rows"][0]
    assert (direct["staged"], staged["staged"]) == (False, True)
    assert staged["time_s"] - direct["time_s"] == pytest.approx(2 * 1e6 / 8e9, rel=1e-6)
    assert ask(gpus, "transfer", "--bytes", "1MB")["rows"][0]["staged"] is False
    assert ask(gpus, "transfer", "--bytes", "1MB", "--hosts")["rows"][0]["staged"] is False


def test_one_rank_a_gpu_or_with_hosts_one_a_node(ask, gpus):
    assert ask(gpus, "allreduce")["rows"][0]["ranks"] == 8
    assert ask(gpus, "allreduce", "--nodes", 2)["rows"][0]["ranks"] == 4
    assert ask(gpus, "allreduce", "--hosts")["rows"][0]["ranks"] == 4
    inside = ask(gpus, "allreduce", "--ranks", 2)["rows"][0]
    assert not inside["busiest_link"].startswith("node1")


# Which algorithm


def test_the_library_chooses_by_size_unless_told(ask, card):
    rows = ask(card, "bcast", "--bytes", "1KiB,64MiB", "--ranks", "4")["rows"]
    assert {row["algorithm_chosen_by"] for row in rows} == {"mpich"}
    (row,) = ask(card, "reduce-scatter", "--bytes", "1KiB", "--algorithm", "recursive-halving")["rows"]
    assert (row["algorithm"], row["algorithm_chosen_by"]) == ("recursive_halving", "--algorithm")


def test_a_row_for_each_size_and_number_of_ranks(ask, card):
    rows = ask(card, "allreduce", "--bytes", "1KiB, 1 MiB", "--ranks", "2,3,4")["rows"]
    assert [(row["ranks"], row["bytes"]) for row in rows] == [
        (ranks, size) for ranks in (2, 3, 4) for size in (1024.0, 1048576.0)
    ]


@given(
    collective=st.sampled_from(sorted(ALGORITHMS)),
    ranks=st.integers(2, 8),
    nbytes=st.integers(0, 10**7),
    data=st.data(),
)
@check
def test_what_is_sent_is_what_the_schedule_says(tmp_path_factory, collective, ranks, nbytes, data):
    path = tmp_path_factory.mktemp("card") / "eight.yaml"
    path.write_text(CORES + GPUS)
    algorithm = data.draw(st.sampled_from([a for a in ALGORITHMS[collective] if usable(collective, a, ranks)]))
    answer = ask_collective(load_machine(str(path)), collective, ranks, nbytes, algorithm=algorithm)
    flat, size = collective.removesuffix("v"), 0 if collective == "barrier" else nbytes
    table = schedule(flat, algorithm, ranks, size)
    empty = nbytes == 0 and collective in {"alltoallv", "gatherv"} and algorithm in {"scattered", "linear"}
    assert answer.messages == (0 if empty else len(table))
    assert answer.sent_bytes == pytest.approx(table.nbytes.sum())
    assert answer.time_s > 0.0 or empty
    assert all(0.0 < use.mean_utilization <= use.peak_utilization <= 1.0 + 1e-9 for use in answer.links.values())


# What it hangs on


def paths(answer):
    return {value["path"] for value in answer["uncalibrated"]}


def test_only_what_was_used_is_owned_up_to(ask, gpus):
    assert paths(ask(gpus, "transfer")) == set()
    assert paths(ask(gpus, "transfer", "--to", 2)) == {"machine.network.latency"}
    assert paths(ask(gpus, "allgather")) == {"machine.network.latency"}
    assert paths(ask(gpus, "allreduce")) == {"machine.network.latency", "machine.gpu.memory_bandwidth"}
    assert paths(ask(gpus, "allreduce", "--hosts")) == {"machine.network.latency"}


def test_staging_hangs_on_the_host(gpus):
    card = load_machine(str(gpus))
    used = [path for path, _ in ask_transfer(card, 1e6, 0, 2).quantities]
    assert {"machine.host.to_device", "machine.host.from_device", "machine.cpu.memory_bandwidth"} <= set(used)
    inside = [path for path, _ in ask_transfer(card, 1e6, 0, 1).quantities]
    fields = ("pcie.bandwidth", "pcie.duplex", "pcie.latency", "mpi.overhead", "mpi.eager")
    assert inside == [f"machine.{field}" for field in fields]


def test_the_scope_says_what_was_modelled(ask, gpus):
    scope = ask(gpus, "allreduce")["scope"]
    assert scope["modelled"][0] == "pcie and wire, shared max-min fairly"
    assert "staging through host memory: two host links more" in scope["modelled"]
    assert all(entry["what"] and entry["why"] for entry in scope["left_out"])


# The table


def test_the_table_says_what_the_json_does(run_cli, card):
    ran = run_cli("network", card, "allgather", "--bytes", "1MB", "--algorithm", "ring")
    assert ran.code == 0
    lines = ran.out.splitlines()
    assert lines[0].startswith(f"allgather on {card}, 4 ranks, MPI mpich")
    assert "3.01 ms" in ran.out
    assert "node0.nic.out" in ran.out
    assert "algorithm: as asked for" in ran.out
    assert "not calibrated: hangs on 1 assumed value (listed by --json)" in ran.out
    assert "staged" not in ran.out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["allgather", "--algorithm", "ring"], "most pairs are faster than that or eager senders run ahead"),
        (["alltoall", "--algorithm", "linear"], "the closed form sends one message after the other"),
        (
            ["alltoall", "--bytes", "32KiB,1MiB"],
            "most pairs are faster than that or eager senders run ahead, or the closed form sends one message after "
            "the other",
        ),
    ],
)
def test_a_ratio_below_one_is_explained_by_the_algorithm(run_cli, card, arguments, reason):
    out = run_cli("network", card, *arguments).out
    assert f"ratio: time over closed form; below 1 where {reason}" in " ".join(out.split())


def test_the_table_fits_into_a_hundred_columns(run_cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    ran = run_cli("network", "frontera-rtx:staged", "bcast", "--bytes", "64KiB,4MiB", "--ranks", "4,16")
    assert max(map(len, ran.out.splitlines())) <= 100
    assert "…" not in ran.out
    out = run_cli("network", "frontera-rtx", "allreduce", "--bytes", "1KiB,64MiB", "--ranks", "4,88").out
    assert max(map(len, out.splitlines())) <= 100
    assert "socket0-socket1" in out  # in one piece
    assert "staged through host memory: two host links more" in ran.out


def test_the_answer_goes_to_a_file(run_cli, ask, card, tmp_path):
    target = tmp_path / "x.json"
    ran = run_cli("network", card, "barrier", "--json", target)
    assert f"wrote {target}\n" in ran.err
    assert json.loads(target.read_text()) == ask(card, "barrier")


# The display


def test_the_display_of_the_manta_cluster_by_copy_threads(ask, card):
    """Ize et al., section 5.5: 55 frames/s with one copy thread, and 135 frames/s as the bound."""
    answer = ask(card, "display", "--copy-threads", "1,2,3,4")
    rows = answer["rows"]
    assert [row["copy_threads"] for row in rows] == [1, 2, 3, 4]
    assert [round(row["frames_per_s"]) for row in rows] == [55, 110, 128, 128]
    assert {round(row["payload_bound_frames_per_s"]) for row in rows} == {135}
    assert {row["payload_bytes_per_frame"] for row in rows} == {1920 * 1080 * 7}
    assert {row["messages_per_frame"] for row in rows} == {2493}
    assert rows[3]["frames_per_s"] == pytest.approx(rows[3]["wire_bound_frames_per_s"], rel=1e-3)
    assert [row["bottleneck"] for row in rows] == ["copy threads", "copy threads", "adapter", "adapter"]
    assert paths(answer) == {"machine.display.copy_bandwidth"}


def test_the_display_takes_the_cards_values_by_default(ask, card):
    (row,) = ask(card, "display")["rows"]
    assert row["copy_threads"] == 3
    (tiles,) = ask(card, "display", "--tiles", "--resolution", "1920x1080", "--frames", 10)["rows"]
    assert tiles["payload_bytes_per_frame"] < row["payload_bytes_per_frame"]
    (wall,) = ask(card, "display", "--display-nodes", 2, "--message-pixels", 64)["rows"]
    assert wall["messages_per_frame"] == 1920 * 1080 // 2 // 64


def test_the_display_as_a_table(run_cli, card):
    out = run_cli("network", card, "display", "--copy-threads", "1,3").out
    assert "1920x1080 pixels into the display" in out
    assert "the adapter could take 135 frames/s of payload, and takes 128 of whole packets" in out
    assert "not calibrated: hangs on 1 fitted value (listed by --json)" in out


# Mistakes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("allredcue", "unknown pattern 'allredcue'; did you mean 'allreduce'? (known: allgather, allgatherv, "),
        ("allreduce --ranks 5", "--ranks 5: Four nodes has room for 2 to 4 ranks, one a node"),
        ("allreduce --ranks 1", "--ranks 1: Four nodes has room for 2 to 4 ranks, one a node"),
        ("allreduce --ranks 3 --nodes 2", "--ranks 3: Four nodes has room for 2 ranks, one a node in 2 nodes"),
        ("allreduce --ranks 2,", "--ranks 2,: expected whole numbers from 1 on, separated by commas, such as 1,2,4"),
        ("allreduce --nodes 1", "Four nodes has one node in use, and a message goes between two"),
        ("allreduce --nodes 9", "--nodes 9: Four nodes has 1 to 4 nodes to use"),
        (
            "allreduce --algorithm rng",
            "--algorithm rng: allreduce has no such algorithm; did you mean 'ring'? "
            "(4 ranks can take: recursive_doubling, rabenseifner, ring)",
        ),
        (
            "allgather --algorithm recursive-doubling --ranks 3",
            "--algorithm recursive_doubling: it needs a power of two of ranks, got 3 (3 ranks can take: bruck, ring)",
        ),
        ("allreduce --bytes 4", "--bytes 4: expected a size such as '16 GiB', got '4' without a unit"),
        (
            "allreduce --bytes 1KiB,4mib",
            "--bytes 1KiB,4mib: unknown unit 'mib'; did you mean 'MiB'? (expected a size such as '16 GiB')",
        ),
        ("allreduce --bytes 1e30B", "--bytes 1e30B: expected 0 B to 1 TB"),
        ("allreduce --bytes=-1B", "--bytes -1B: expected 0 B to 1 TB"),
        ("barrier --bytes 4MiB", "--bytes 4MiB: a barrier sends none"),
        ("allreduce --from 0", "--from goes with transfer, not with allreduce"),
        ("allreduce --to 0", "--to goes with transfer, not with allreduce"),
        ("transfer --ranks 3", "--ranks goes with a collective, not with transfer"),
        ("transfer --tiles", "--tiles goes with display, not with transfer"),
        ("display --bytes 1MB", "--bytes goes with a collective or transfer, not with display"),
        ("transfer --to 4", "--to 4: the nodes in use of Four nodes are numbered from 0 to 3"),
        ("transfer --from=-1", "--from -1: the nodes in use of Four nodes are numbered from 0 to 3"),
        ("transfer --from 1", "--from 1 --to 1: a message goes from one rank to another"),
        ("display --resolution 1920", "--resolution 1920: expected WIDTHxHEIGHT in pixels such as 2560x1080"),
        ("display --copy-threads 0", "--copy-threads 0: expected whole numbers from 1 on, separated by commas, "),
        ("transfer --json x.txt", "--json x.txt: expected a file that ends in .json"),
        ("transfer --set workload.x=1", "--set workload.x=1: a path starts with machine., got 'workload.x'"),
    ],
)
def test_mistakes_are_one_clear_message(run_cli, card, arguments, message):
    ran = run_cli("network", card, *arguments.split(" "))
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.startswith(f"simrender: {message}")
    assert ran.err.count("\n") == 1


def test_machines_that_lack_what_is_asked_for(run_cli, card, gpus):
    def message(*arguments):
        ran = run_cli("network", *arguments)
        assert ran.code == 2
        return ran.err

    assert message("dgx2", "bcast").endswith("has no MPI on its card; add a section mpi\n")
    assert message(gpus, "display").endswith("Four nodes has no display on its card; add a section display\n")
    alone = ("--set", "machine.nodes=1")
    assert message(card, "bcast", *alone).endswith("Four nodes has one node, and a message goes between two\n")
    down = "machine.disturbances=[{link: node0.nic.out, share: 0, start: 0 s}]"
    assert "the link node0.nic.out is down" in message(card, "transfer", "--set", down)


def test_a_message_between_gpus_owns_up_to_the_slots_it_goes_over(capsys):
    with pytest.raises(SystemExit):
        main(["network", "frontera-rtx", "transfer", "--from", "0", "--to", "4", "--bytes", "1MiB", "--json", "-"])
    paths = {value["path"] for value in json.loads(capsys.readouterr().out)["uncalibrated"]}
    assert {"machine.pcie.latency", "machine.network.latency", "machine.network.bandwidth"} <= paths
    assert not any("leaf" in path or "nvlink" in path or "socket" in path for path in paths)
