import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import units
from simrender.errors import UnitError

check = settings(deadline=None, derandomize=True)

B, S, RAY, BPS, RPS, ONE = "B", "s", "ray", "B/s", "ray/s", "1"

ACCEPTED = [
    # sizes: powers of 1000 and of 1024; b is a bit
    ("0 B", B, 0.0),
    ("1 B", B, 1.0),
    ("8 b", B, 1.0),
    ("1 b", B, 0.125),
    ("1 kB", B, 1e3),
    ("1 KiB", B, 1024.0),
    ("24 MB", B, 24e6),
    ("24 Mb", B, 3e6),
    ("24 Gb", B, 3e9),
    ("24 GB", B, 24e9),
    ("24 Gib", B, 3.0 * 2**30),
    ("24 GiB", B, 24.0 * 2**30),
    ("1.5 TiB", B, 1.5 * 2**40),
    ("2 PB", B, 2e15),
    ("2 PiB", B, 2.0**51),
    ("1_000 B", B, 1000.0),
    ("1_000.5 kB", B, 1000500.0),
    ("0.1 kB", B, 100.0),
    ("-1 GiB", B, -(2.0**30)),
    # bandwidths
    ("100 Gb/s", BPS, 12.5e9),
    ("12.5 GB/s", BPS, 12.5e9),
    ("145.57 GB/s", BPS, 145.57e9),
    ("1 GiB/s", BPS, 2.0**30),
    ("9600 b/s", BPS, 1200.0),
    ("1e9 B/s", BPS, 1e9),
    # times, to the last bit
    ("3 s", S, 3.0),
    ("2.5 us", S, 2.5e-6),
    ("1.83 us", S, 1.83e-6),
    ("0.1 us", S, 1e-7),
    ("2.5 µs", S, 2.5e-6),
    ("2.5 \u03bcs", S, 2.5e-6),
    ("5 ms", S, 5e-3),
    ("7 ns", S, 7e-9),
    ("1 ps", S, 1e-12),
    # rays and rates of rays
    ("4096 ray", RAY, 4096.0),
    ("3 kray", RAY, 3e3),
    ("230 Mray/s", RPS, 230e6),
    ("1.1 Gray/s", RPS, 1.1e9),
    # plain numbers
    ("8", ONE, 8.0),
    (8, ONE, 8.0),
    (0.707, ONE, 0.707),
    ("1e9", ONE, 1e9),
    ("+.5e-1", ONE, 0.05),
    ("5.", ONE, 5.0),
    ("50 %", ONE, 0.5),
    ("100%", ONE, 1.0),
    ("1e-400", ONE, 0.0),
    # spaces
    ("16GiB", B, 16.0 * 2**30),
    ("  16   GiB ", B, 16.0 * 2**30),
]


@pytest.mark.parametrize(("text", "dimension", "value"), ACCEPTED)
def test_accepted(text, dimension, value):
    parsed = units.parse(text, dimension)
    assert parsed == value
    assert type(parsed) is float


SIZE = "expected a size such as '16 GiB'"
TIME = "expected a time such as '2.5 us'"
BANDWIDTH = "expected a bandwidth such as '12.5 GB/s'"
RATE = "expected a ray rate such as '230 Mray/s'"
NUMBER = "expected a number such as '8'"

REFUSED = [
    # no unit, or no number
    (16, B, f"{SIZE}, got the number 16 without a unit"),
    (12.5, BPS, f"{BANDWIDTH}, got the number 12.5 without a unit"),
    ("16", B, f"{SIZE}, got '16' without a unit"),
    ("GiB", B, f"{SIZE}, got 'GiB'"),
    ("", B, f"{SIZE}, got ''"),
    (None, BPS, f"{BANDWIDTH}, got nothing"),
    (True, ONE, f"{NUMBER}, got True"),
    ([1], S, f"{TIME}, got [1]"),
    # another dimension
    ("3 us", BPS, f"{BANDWIDTH}, got a time: '3 us'"),
    ("100 Gb", BPS, f"{BANDWIDTH}, got a size: '100 Gb'"),
    ("100 Gb/s", B, f"{SIZE}, got a bandwidth: '100 Gb/s'"),
    ("230 Mray", RPS, f"{RATE}, got a number of rays: '230 Mray'"),
    ("230 MB/s", RPS, f"{RATE}, got a bandwidth: '230 MB/s'"),
    ("5 %", S, f"{TIME}, got a number: '5 %'"),
    ("5 B", ONE, f"{NUMBER}, got a size: '5 B'"),
    # an unknown unit, with the one that was probably meant
    ("16 GIB", B, f"unknown unit 'GIB'; did you mean 'GiB'? ({SIZE})"),
    ("16 mb", B, f"unknown unit 'mb'; did you mean 'MB'? ({SIZE})"),
    ("16 KB", B, f"unknown unit 'KB'; did you mean 'kB'? ({SIZE})"),
    ("16 G", B, f"unknown unit 'G'; did you mean 'GB'? ({SIZE})"),
    ("16 Gbyte", B, f"unknown unit 'Gbyte'; did you mean 'GB'? ({SIZE})"),
    ("100 Gbps", BPS, f"unknown unit 'Gbps'; did you mean 'Gb/s'? ({BANDWIDTH})"),
    ("100 GBps", BPS, f"unknown unit 'GBps'; did you mean 'GB/s'? ({BANDWIDTH})"),
    ("100 Gbit/s", BPS, f"unknown unit 'Gbit/s'; did you mean 'Gb/s'? ({BANDWIDTH})"),
    ("100 GB /s", BPS, f"unknown unit 'GB /s'; did you mean 'GB/s'? ({BANDWIDTH})"),
    ("100 Gbytes/sec", BPS, f"unknown unit 'Gbytes/sec'; did you mean 'GB/s'? ({BANDWIDTH})"),
    ("3 Mrays/s", RPS, f"unknown unit 'Mrays/s'; did you mean 'Mray/s'? ({RATE})"),
    ("3 sec", S, f"unknown unit 'sec'; did you mean 's'? ({TIME})"),
    ("3 usec", S, f"unknown unit 'usec'; did you mean 'us'? ({TIME})"),
    ("1 furlong", S, f"unknown unit 'furlong' ({TIME})"),
    ("1__0 B", B, f"unknown unit '__0 B' ({SIZE})"),
    ("1,5 GB", B, f"unknown unit ',5 GB'; did you mean 'GB'? ({SIZE})"),
    ("1 2 GB", B, f"unknown unit '2 GB'; did you mean 'GB'? ({SIZE})"),
    # not finite
    ("nan GB/s", BPS, f"{BANDWIDTH}, got nan, which is not a finite number"),
    ("-inf s", S, f"{TIME}, got -inf, which is not a finite number"),
    ("1e400 B", B, f"{SIZE}, got inf, which is not a finite number"),
    ("1e308 GB", B, f"{SIZE}, got inf, which is not a finite number"),
    (math.nan, ONE, f"{NUMBER}, got nan, which is not a finite number"),
    (math.inf, ONE, f"{NUMBER}, got inf, which is not a finite number"),
    (10**400, ONE, f"{NUMBER}, got inf, which is not a finite number"),
]


@pytest.mark.parametrize(("text", "dimension", "message"), REFUSED)
def test_refused(text, dimension, message):
    with pytest.raises(UnitError) as error:
        units.parse(text, dimension)
    assert str(error.value) == message


def test_an_absurd_exponent_takes_no_time():
    assert units.parse("1e-999999999 s", S) == 0.0
    with pytest.raises(UnitError):
        units.parse("1e999999999 s", S)


DIMENSIONS = {
    B: {"B": 1, "kB": 10**3, "GiB": 2**30, "Gb": Fraction(10**9, 8)},
    BPS: {"B/s": 1, "GB/s": 10**9, "Mb/s": 125_000, "TiB/s": 2**40},
    S: {"s": 1, "ms": Fraction(1, 10**3), "us": Fraction(1, 10**6), "ps": Fraction(1, 10**12)},
    RPS: {"ray/s": 1, "Mray/s": 10**6},
}
UNITS = [(dimension, unit, factor) for dimension, known in DIMENSIONS.items() for unit, factor in known.items()]


@check
@given(st.sampled_from(UNITS), st.floats(0.0, 1e12))
def test_what_is_written_is_what_is_read_to_the_last_bit(unit, number):
    dimension, symbol, factor = unit
    assert units.parse(f"{number!r} {symbol}", dimension) == float(Fraction(repr(number)) * factor)


@check
@given(st.floats(1e-12, 1e17))
def test_a_size_for_a_person_reads_back_to_three_digits(nbytes):
    assert units.parse(units.format_bytes(nbytes), B) == pytest.approx(nbytes, rel=0.0051)


@check
@given(st.floats(1e-12, 1e6))
def test_a_duration_for_a_person_reads_back_to_three_digits(seconds):
    assert units.parse(units.format_seconds(seconds), S) == pytest.approx(seconds, rel=0.0051)


@check
@given(st.floats(0.0, 1e17))
def test_a_count_for_a_person_reads_back_to_three_digits(count):
    assert units.parse(f"{units.format_count(count)}ray", RAY) == pytest.approx(count, rel=0.0051)


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        (units.format_bytes(0), "0 B"),
        (units.format_bytes(999.4), "999 B"),
        (units.format_bytes(999.6), "1 kB"),
        (units.format_bytes(48.5e9), "48.5 GB"),
        (units.format_bytes(-537e6), "-537 MB"),
        (units.format_bytes(1234e15), "1234 PB"),
        (units.format_seconds(0.0), "0 ns"),
        (units.format_seconds(2.5e-6), "2.5 us"),
        (units.format_seconds(0.345), "345 ms"),
        (units.format_seconds(0.99949), "999 ms"),
        (units.format_seconds(0.99951), "1 s"),
        (units.format_seconds(86400.0), "86400 s"),
        (units.format_count(24e6), "24 M"),
        (units.format_count(3.14e9), "3.14 G"),
    ],
)
def test_what_a_person_reads(written, expected):
    assert written == expected
