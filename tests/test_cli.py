"""The command line: what it prints and writes when all goes well, and when a cache or a disk does not."""

import io
import itertools
import json
import os
import re

import pytest
from PIL import Image

from simrender.files import write

# Results


def results(ran):
    """The JSON on stdout: nothing else may be there."""
    assert ran.code in {0, 3}, ran
    return json.loads(ran.out)


def test_json_to_stdout_is_json_and_nothing_else(run_cli, tiny_card):
    ran = run_cli("run", "dgx2", tiny_card, "--json", "-", "--gpus", 2)
    result = results(ran)
    assert ran.code == 0
    assert (result["machine"], result["workload"], result["gpus"]) == ("dgx2", "tiny", 2)
    assert result["frames_per_s"] == pytest.approx(1 / result["frame_time_s"])
    assert result["feasible"] is True
    assert result["seed"] == 1
    assert len(result["image_sha256"]) == len(result["event_log_sha256"]) == 64
    assert re.fullmatch(r"simulated in [0-9.]+ s\n", ran.err)


def test_json_has_no_constants_that_json_lacks(run_cli, tiny_card):
    def refuse(constant):
        raise AssertionError(constant)

    json.loads(run_cli("run", "dgx2", tiny_card, "--json=-").out, parse_constant=refuse)


def test_json_to_a_file_is_the_same_json(run_cli, tiny_card, tmp_path):
    target = tmp_path / "x.json"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--json", target)
    assert f"wrote {target}\n" in ran.err
    assert "frames/s" in ran.out
    assert json.loads(target.read_text()) == results(run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--json", "-"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bumpy.ply", "tiny.yaml", "x.json"]


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    target = tmp_path / "x.json"
    target.write_text("old")

    def fail(file):
        file.write(b"half of the ne")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write(target, fail)
    assert target.read_text() == "old"
    write(target, lambda file: file.write(b"new"))
    assert target.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_a_full_disk_is_one_message(run_cli, tiny_card, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device", str(tmp_path / "x.json"))

    monkeypatch.setattr("simrender.report.files.write_json", full)
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 1, "--json", tmp_path / "x.json")
    assert ran.code == 2
    assert ran.err == f"simrender: {tmp_path / 'x.json'}: No space left on device\n"


TIGHT = "machine.gpu.memory=1075 MB"
"""1 GiB is reserved, which leaves 1.26 MB: too little for one GPU, enough for each of two."""


def test_a_run_that_does_not_fit_exits_with_3_and_says_what_would_do(run_cli, tiny_card, tmp_path):
    image = tmp_path / "x.png"
    command = ("run", "dgx2", tiny_card, "--gpus", 1, "--set", TIGHT)
    ran = run_cli(*command, "--json", "-", "--image", image)
    assert ran.code == 3
    result = results(ran)
    assert result["feasible"] is False
    assert result["frame_time_s"] is None
    assert result["frames_per_s"] is None
    assert result["event_log_sha256"] is None
    assert result["memory"]["gpus_needed"] == 2
    assert result["memory"]["needed_bytes"] > result["memory"]["capacity_bytes"] == pytest.approx(1_258_176.0)
    assert not image.exists()
    ran = run_cli(*command)
    assert ran.code == 3
    assert "tiny does not fit on dgx2 under ray_queue_cycling" in ran.out
    assert re.search(r"the fullest GPU would need 1\.3\d MB and has 1\.26 MB\.", ran.out)
    assert "2 such GPUs would do." in ran.out


def test_the_gpus_that_are_needed_are_enough(run_cli, tiny_card):
    result = results(run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 1, "--set", TIGHT, "--json", "-"))
    assert result["feasible"] is True


def test_the_timeline_is_a_chrome_trace_without_overlaps(run_cli, tiny_card, tmp_path):
    target = tmp_path / "t.json"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--timeline", target)
    assert ran.code == 0
    trace = json.loads(target.read_text())
    events = [event for event in trace["traceEvents"] if event["ph"] == "X"]
    names = {event["args"]["name"] for event in trace["traceEvents"] if event["name"] == "process_name"}
    assert names == {"gpu0", "gpu1", "gpu2", "gpu3", "links"}
    assert {event["cat"] for event in events} == {"kernel", "copy"}
    assert {event["ph"] for event in trace["traceEvents"]} == {"X", "M", "C"}
    tracks = {}
    for event in events:
        assert event["dur"] >= 0
        tracks.setdefault((event["pid"], event["tid"]), []).append((event["ts"], event["ts"] + event["dur"]))
    assert set(tracks) == set(itertools.product(range(4), (1, 2)))
    for spans in tracks.values():
        assert all(end <= begin + 1e-6 for (_, end), (begin, _) in itertools.pairwise(sorted(spans)))  # a picosecond
    end = max(end for spans in tracks.values() for _, end in spans)
    frame = results(run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--json", "-"))
    assert end == pytest.approx(frame["frame_time_s"] * 1e6, rel=1e-9)
    assert len(events) == frame["counts"]["spans"]


def test_the_timeline_and_the_image_are_pictures(run_cli, tiny_card, tmp_path):
    timeline, image = tmp_path / "t.png", tmp_path / "i.png"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--timeline", timeline, "--image", image)
    assert ran.code == 0
    assert ran.err.splitlines()[:2] == [f"wrote {image} (64x36)", f"wrote {timeline}"]
    with Image.open(timeline) as picture:
        assert picture.format == "PNG"
        assert 800 <= picture.width <= 4000
        assert 200 <= picture.height <= 4000
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20
    with Image.open(image) as picture:
        assert (picture.format, picture.size, picture.mode) == ("PNG", (64, 36), "RGB")
        assert len(picture.getcolors(1 << 24)) > 100


def test_a_real_mesh_file_is_a_workload(run_cli, ply, tmp_path):
    small = ("--set", "workload.traced.resolution=32x18", "--set", "workload.published.samples=1")
    result = results(run_cli("run", "rtx-server-a40", ply, *small, "--json", "-"))
    assert result["workload"] == "airplane"
    assert result["counts"]["traced_camera_rays"] == 32 * 18
    assert result["counts"]["ray_weight"] == 3600.0


# The trace cache


def traced(run_cli, tiny_card, folder, *more):
    return run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 1, "--cache", folder, "--json", "-", *more)


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied", "replaced"])
def test_a_damaged_cache_file_is_discarded_and_computed_again(run_cli, tiny_card, tmp_path, damage):
    folder = tmp_path / "traces"
    whole = traced(run_cli, tiny_card, folder)
    path = next(folder.rglob("001-hits.npz"))
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0xFF
    path.write_bytes(
        {"cut": content[: len(content) // 2], "flipped": flipped, "emptied": b"", "replaced": b"?"}[damage]
    )
    again = traced(run_cli, tiny_card, folder)
    assert again.code == 0
    assert again.out == whole.out
    notes = [line for line in again.err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert notes[0].startswith(f"note: the cache file {path} is damaged")
    assert "it is discarded and computed again" in notes[0]
    healed = traced(run_cli, tiny_card, folder)
    assert healed.out == whole.out
    assert "note:" not in healed.err


def test_a_wholly_damaged_cache_costs_one_note(run_cli, tiny_card, tmp_path):
    folder = tmp_path / "traces"
    whole = traced(run_cli, tiny_card, folder)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files
    for path in files:
        path.write_bytes(b"not an archive")
    again = traced(run_cli, tiny_card, folder)
    assert again.out == whole.out
    assert again.err.count("note: ") == 1


def test_a_cache_of_another_run_changes_nothing(run_cli, tiny_card, tmp_path):
    folder = tmp_path / "traces"
    one, other = traced(run_cli, tiny_card, folder), traced(run_cli, tiny_card, folder, "--seed", 2)
    assert one.out != other.out
    assert traced(run_cli, tiny_card, folder).out == one.out


def test_a_cache_that_cannot_be_written_costs_a_note(run_cli, tiny_card, tmp_path):
    whole = traced(run_cli, tiny_card, tmp_path / "traces")
    (tmp_path / "file").write_text("")
    ran = traced(run_cli, tiny_card, tmp_path / "file")
    assert (ran.code, ran.out) == (0, whole.out)
    notes = [line for line in ran.err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert notes[0].startswith(f"note: cannot write the trace cache in {tmp_path / 'file'}")


def test_the_users_own_cache_is_not_touched_by_tests(trace_cache):
    assert os.environ["SIMRENDER_CACHE"] == str(trace_cache)


# list, show, trace


def test_list(run_cli):
    ran = run_cli("list")
    assert (ran.code, ran.err) == (0, "")
    assert [line for line in ran.out.splitlines() if line in {"machines", "workloads", "policies"}] == [
        "machines", "workloads", "policies",
    ]  # fmt: skip
    assert re.search(r"^dgx2 +NVIDIA DGX-2 \(16 V100 32 GB, NVSwitch\)", ran.out, re.M)
    assert re.search(r"^ray_queue_cycling +Ray queue cycling, ", ran.out, re.M)
    assert "machines" not in run_cli("list", "policies").out


def test_show_a_machine_with_the_source_of_every_value(run_cli):
    ran = run_cli("show", "dgx2")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("NVIDIA DGX-2 (16 V100 32 GB, NVSwitch)\n")
    assert re.search(r"^gpus +16 *$", ran.out, re.M)
    assert re.search(r"^gpu *\n  model +Tesla V100", ran.out, re.M)
    assert re.search(r"^  ray_tracing_cores +false *$", ran.out, re.M)
    assert re.search(r"^  rate_primitives +1e9 +assumed +the size of scene", ran.out, re.M)
    assert re.search(r"^  memory_bandwidth +802 GB/s \(778 to 895 GB/s\) +measured +gpu-stream copy", ran.out, re.M)
    assert "RQC table 1: 16 x 32 GB" in ran.out


def test_show_a_card_by_its_path(run_cli, tiny_card):
    ran = run_cli("show", tiny_card)
    assert ran.code == 0
    assert ran.out.startswith("A bumpy square\n")
    assert re.search(r"^published *\n  resolution +64x36 *$", ran.out, re.M)
    assert re.search(r"^  position +\[2\.0, -2\.0, 1\.5\] *$", ran.out, re.M)


@pytest.mark.parametrize("columns", [80, 100, 160])
def test_a_card_fits_the_width_it_is_given(run_cli, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    out = run_cli("show", "dgx2").out
    lines = out.splitlines()
    assert max(len(line) for line in lines) <= columns
    start = next(line for line in lines if line.startswith("field")).index("source")
    below = [line for line in lines[lines.index("") + 1 :] if line.strip()]
    assert all(line[start - 2 : start] == "  " for line in below if len(line) > start), "a column runs into the next"
    words = " ".join(" ".join(line[start:].strip() for line in below).split())
    assert "SM copies reach 200 to 231 GB/s of 273 GB/s between two A100; the same share is taken here" in words
    assert "\x1b" not in out


@pytest.mark.parametrize(
    ("text", "mistake"),
    [
        ("{}", "1:1: expected the card of a machine or a workload, got neither's fields"),
        ("title: A [/b] c\nscene: 3\n", "2:8: scene: expected a section with the fields file, generator, arguments, "),
        ("gpu: {value: 1, range: 5, source: 3, status: 2}\n", "1:7: gpu.value: unknown field"),
    ],
)
def test_show_a_card_with_mistakes(run_cli, tiny_card, text, mistake):
    tiny_card.write_text(text)
    ran = run_cli("show", tiny_card)
    assert (ran.code, ran.out) == (2, "")
    assert f"{tiny_card}:{mistake}" in ran.err


def test_show_an_odd_policy_of_a_card(run_cli, tiny_card):
    tiny_card.write_text(
        f"{tiny_card.read_text()}policy: {{name: 'A [/b] c', odd: {{value: 1, range: 5, status: 2}}}}\n"
    )
    ran = run_cli("show", tiny_card)
    assert ran.code == 0
    assert "A [/b] c" in ran.out


FAST_CARD = """\
extends: dgx2
nvlink: {bandwidth: 300 GB/s}
variants:
  small: {title: Four of them, gpus: 4}
  late: {nvlink: {latency: 1 ms}}
"""


def test_show_says_which_values_another_card_says(run_cli, tmp_path):
    path = tmp_path / "fast.yaml"
    path.write_text(FAST_CARD)
    out = run_cli("show", path).out
    title = "NVIDIA DGX-2 (16 V100 32 GB, NVSwitch), as changed by fast"
    assert out.startswith(f"{title}\nfast, {path}\n\nvariants\n")
    assert re.search(r"^  fast:small  Four of them *$", out, re.M)
    assert re.search(rf"^  fast:late   {re.escape(title)}, variant late *$", out, re.M)
    assert re.search(r"^gpus +16 +from dgx2 *$", out, re.M)
    assert re.search(r"^  bandwidth +300 GB/s *$", out, re.M)
    assert re.search(r"^  latency +2\.5 us \(2\.26 to 2\.76 us\) +measured, from dgx2 +p2pBandwidth", out, re.M)


def test_show_a_variant(run_cli, tmp_path):
    path = tmp_path / "fast.yaml"
    path.write_text(FAST_CARD)
    out = run_cli("show", f"{path}:late").out
    assert f"\nfast:late, {path}\n" in out
    assert "variants" not in out
    assert re.search(r"^  bandwidth +300 GB/s *$", out, re.M)
    assert re.search(r"^  latency +1 ms +variant *$", out, re.M)
    ran = run_cli("show", "dgx2:late")
    assert (ran.code, ran.err) == (2, "simrender: unknown variant of dgx2 'late' (known: none)\n")


def test_a_variant_runs_wherever_a_name_does(run_cli, tmp_path, tiny_card):
    path = tmp_path / "fast.yaml"
    path.write_text(FAST_CARD)
    tiny_card.write_text(f"{tiny_card.read_text()}variants: {{one: {{published: {{samples: 1}}}}}}\n")
    result = results(run_cli("run", f"{path}:small", f"{tiny_card}:one", "--json", "-"))
    assert (result["machine"], result["workload"], result["gpus"]) == (f"{path}:small", "tiny:one", 4)
    assert result["counts"]["traced_camera_rays"] == 64 * 36
    ran = run_cli("run", f"{path}:smal", tiny_card)
    assert (ran.code, ran.err) == (
        2, "simrender: unknown variant of fast 'smal'; did you mean 'small'? (known: late, small)\n",
    )  # fmt: skip


def test_show_a_policy_with_its_parameters(run_cli):
    ran = run_cli("show", "ray_queue_cycling")
    assert ran.code == 0
    assert ran.out.startswith("ray_queue_cycling\n")
    assert 'copy : "explicit" or "implicit"' in ran.out


def test_trace(run_cli, tiny_card, tmp_path):
    image = tmp_path / "x.png"
    first = run_cli("trace", tiny_card, "--cache", tmp_path / "traces", "--image", image)
    assert first.code == 0
    assert first.out.startswith("tiny: 64x36, 2 paths a pixel")
    assert re.search(r"^camera +4,608 ", first.out, re.M)
    assert "by embreex alone" in first.out
    assert f"wrote {image} (64x36)\n" in first.err
    second = run_cli("trace", tiny_card, "--cache", tmp_path / "traces")
    assert "came from the cache" in second.out
    rays = re.compile(r"^all +([\d,]+) ", re.M)
    assert rays.search(first.out)[1] == rays.search(second.out)[1]


def test_the_picture_of_a_trace_is_that_of_any_run(run_cli, tiny_card, tmp_path):
    pictures = [tmp_path / f"{i}.png" for i in range(3)]
    run_cli("trace", tiny_card, "--image", pictures[0])
    run_cli("run", "dgx2", tiny_card, "--gpus", 3, "--islands", 1, "--image", pictures[1])
    run_cli("run", "hgx-a100", tiny_card, "--policy", "image_parallel", "--image", pictures[2])
    assert len({io.BytesIO(p.read_bytes()).getvalue() for p in pictures}) == 1


def test_version_and_help(run_cli):
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", run_cli("--version").out)
    for command in ((), ("--help",), ("run", "--help")):
        ran = run_cli(*command)
        assert (ran.code, ran.err) == (0, "")
        assert "Usage: simrender" in ran.out
