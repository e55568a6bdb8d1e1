import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.timeline import KINDS, Timeline

SECOND = 10**12
TRACE, COPY = KINDS.index("trace"), KINDS.index("copy")

SPANS = [
    # device, kind, start, end, bytes, rays
    (1, TRACE, 0, 2 * SECOND, 0.0, 100.0),
    (0, TRACE, 0, 3 * SECOND, 0.0, 150.0),
    (0, COPY, 3 * SECOND, 4 * SECOND, 8800.0, 100.0),
    (1, TRACE, 2 * SECOND, 2 * SECOND + 1, 5.0, 0.5),
]


def timeline(spans=SPANS, gpus=3):
    log = Timeline(gpus)
    for span in spans:
        log.add(*span)
    return log


def test_it_keeps_spans_in_the_order_in_which_they_were_settled():
    log = timeline()
    assert len(log) == 4
    assert log.device == [1, 0, 0, 1]
    assert log.end == [2 * SECOND, 3 * SECOND, 4 * SECOND, 2 * SECOND + 1]
    assert len(Timeline(2)) == 0


# The hash


def test_equal_logs_have_equal_hashes():
    assert timeline().sha256() == timeline().sha256()
    assert len(timeline().sha256()) == 64


def test_the_hash_is_the_same_in_another_process():
    code = f"from simrender.timeline import Timeline\nlog = Timeline(3)\nfor span in {SPANS}:\n    log.add(*span)\n"
    code += "print(log.sha256())"
    environment = os.environ | {"PYTHONHASHSEED": "12345"}
    other = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert other.stdout.strip() == timeline().sha256()


@pytest.mark.parametrize("field", range(6))
@pytest.mark.parametrize("row", range(4))
def test_any_field_of_any_span_changes_the_hash(row, field):
    spans = [list(span) for span in SPANS]
    spans[row][field] += 1
    assert timeline(spans).sha256() != timeline().sha256()


def test_the_smallest_change_of_an_amount_changes_the_hash():
    spans = [list(span) for span in SPANS]
    spans[2][4] = np.nextafter(spans[2][4], np.inf)
    assert timeline(spans).sha256() != timeline().sha256()


def test_order_length_and_number_of_gpus_change_the_hash():
    hashes = {
        timeline().sha256(),
        timeline([SPANS[1], SPANS[0], *SPANS[2:]]).sha256(),
        timeline(SPANS[:3]).sha256(),
        timeline([*SPANS, SPANS[3]]).sha256(),
        timeline(gpus=4).sha256(),
        Timeline(3).sha256(),
        Timeline(0).sha256(),
    }
    assert len(hashes) == 7


def test_no_two_columns_are_mistaken_for_each_other():
    """A value that moves from one column to the next is another log."""
    one, other = Timeline(1), Timeline(1)
    one.add(0, 1, 0, 0, 0.0, 0.0)
    other.add(1, 0, 0, 0, 0.0, 0.0)
    assert one.sha256() != other.sha256()


# The table


def test_the_table_has_a_row_a_span_sorted_by_start_then_device():
    table = timeline().frame()
    assert list(table.columns) == ["device", "kind", "start_s", "end_s", "bytes", "rays"]
    assert table.values.tolist() == [
        ["gpu0", "trace", 0.0, 3.0, 0.0, 150.0],
        ["gpu1", "trace", 0.0, 2.0, 0.0, 100.0],
        ["gpu1", "trace", 2.0, 2.000000000001, 5.0, 0.5],
        ["gpu0", "copy", 3.0, 4.0, 8800.0, 100.0],
    ]
    assert table.index.tolist() == [0, 1, 2, 3]


def test_spans_that_start_together_on_one_device_stay_in_their_order():
    log = timeline([(0, COPY, 5, 6, 1.0, 0.0), (0, TRACE, 5, 5, 2.0, 0.0), (0, COPY, 5, 9, 3.0, 0.0)])
    assert log.frame()["bytes"].tolist() == [1.0, 2.0, 3.0]


def test_tenth_and_later_devices_are_sorted_by_number():
    log = timeline([(10, TRACE, 0, 1, 0.0, 0.0), (9, TRACE, 0, 1, 0.0, 0.0)], gpus=11)
    assert log.frame()["device"].tolist() == ["gpu9", "gpu10"]


def test_the_table_of_an_empty_log_has_the_same_columns():
    table = Timeline(2).frame()
    assert list(table.columns) == list(timeline().frame().columns)
    assert len(table) == 0
    assert table["start_s"].dtype == float


# Seconds by kind


def test_seconds_by_kind_has_a_figure_for_every_kind_and_gpu():
    seconds = timeline().seconds_by_kind()
    assert list(seconds) == list(KINDS)
    assert seconds["trace"] == [3.0, 2.000000000001, 0.0]
    assert seconds["copy"] == [1.0, 0.0, 0.0]
    assert all(seconds[kind] == [0.0, 0.0, 0.0] for kind in KINDS if kind not in {"trace", "copy"})


def test_nothing_takes_no_seconds():
    assert Timeline(2).seconds_by_kind() == {kind: [0.0, 0.0] for kind in KINDS}


spans = st.lists(
    st.tuples(st.integers(0, 4), st.integers(0, len(KINDS) - 1), st.integers(0, 10**13), st.integers(0, 10**12)),
    max_size=30,
)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(spans)
def test_the_table_and_the_seconds_agree(drawn):
    log = timeline([(d, k, start, start + length, 0.0, 0.0) for d, k, start, length in drawn], gpus=5)
    table, seconds = log.frame(), log.seconds_by_kind()
    for kind in KINDS:
        for gpu in range(5):
            rows = table[(table["kind"] == kind) & (table["device"] == f"gpu{gpu}")]
            assert seconds[kind][gpu] == pytest.approx((rows["end_s"] - rows["start_s"]).sum(), rel=1e-9, abs=1e-9)


def test_the_log_has_no_column_that_the_hash_could_miss():
    """Whoever adds one must add it to the hash, to the table and to this list."""
    fields = [field.name for field in dataclasses.fields(Timeline)]
    assert fields == ["gpus", "names", "device", "kind", "start", "end", "nbytes", "rays"]


def test_the_busy_share_counts_kernels_in_each_part_of_the_time():
    # Of three processors two trace for two seconds, and one for another; then it sends.
    assert timeline().busy_share(4 * SECOND, 4) == pytest.approx([2 / 3, 2 / 3, 1 / 3, 0.0], abs=1e-9)
    assert timeline().busy_share(4 * SECOND, 1) == pytest.approx([5 / 12])
    assert timeline([]).busy_share(SECOND, 2).tolist() == [0.0, 0.0]
    assert timeline([]).busy_share(0, 2).tolist() == [0.0, 0.0]
