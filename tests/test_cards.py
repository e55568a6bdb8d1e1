import pytest

from simrender.cards import Card, Count, Document, Quantity, Size, split_assignments, written
from simrender.errors import CardError, UsageError
from simrender.hardware.machine import MachineCard, load_machine
from simrender.rays.workload import load_workload
from simrender.rays.workload_card import WorkloadCard

MACHINE = """\
title: Two GPUs
gpus: 2
gpu:
  model: A GPU
  ray_tracing_cores: true
  memory: {value: 48 GiB, source: "a table", status: published}
  reserved_memory: 1 GiB
  memory_bandwidth: {value: 560 GB/s, range: [540 GB/s, 672 GB/s], source: "others reach this", status: assumed}
  launch_latency: 5 us
  coherent_rate: 400 Mray/s
  incoherent_rate: 100 Mray/s
  rate_primitives: 1e9
  half_saturation: 6000 ray
  bvh_triangle_bytes: 50 B
  bvh_instance_bytes: 400 B
pcie:
  bandwidth: 25 GB/s
  duplex: 100 %
  latency: 2 us
  kernel_share: 0.5
  switches: [[0], [1]]
  uplink: 18 GB/s
host: {launch_issue: 2 us, copy_issue: 2 us, readback: 10 us}
"""


def machine(text=MACHINE, *assignments):
    """The card, named m.yaml in messages, with each ``--set`` applied."""
    document = Document(text, "m.yaml")
    for assignment in assignments:
        document.override(MachineCard, assignment, "machine")
    return document.validate(MachineCard)


def mistakes(text=MACHINE, *assignments):
    """What is wrong with it, a list of messages."""
    with pytest.raises(CardError) as error:
        machine(text, *assignments)
    assert str(error.value) == "\n".join(error.value.mistakes)
    return list(error.value.mistakes)


def changed(*pairs):
    text = MACHINE
    for old, new in pairs:
        assert text.count(old) == 1
        text = text.replace(old, new)
    return text


# Reading


def test_a_card_is_read_in_si_units():
    card = machine()
    assert (card.title, card.gpus, card.gpu.ray_tracing_cores) == ("Two GPUs", 2, True)
    assert card.gpu.memory == 48 * 2**30
    assert card.gpu.launch_latency == 5e-6
    assert card.gpu.coherent_rate == 4e8
    assert card.gpu.rate_primitives == 1e9
    assert card.pcie.duplex == 1.0
    assert card.pcie.switches == [[0], [1]]
    assert card.nvlink is None


def test_a_quantity_remembers_where_it_comes_from():
    bandwidth = machine().gpu.memory_bandwidth
    assert bandwidth == 560e9
    assert (bandwidth.text, bandwidth.status, bandwidth.source) == ("560 GB/s", "assumed", "others reach this")
    assert bandwidth.range == (540e9, 672e9)


def test_a_plain_quantity_is_stated_by_its_card():
    latency = machine().gpu.launch_latency
    assert (latency.text, latency.status, latency.source, latency.range) == ("5 us", "stated", "", None)


def test_a_quantity_computes_like_the_float_it_is():
    quantity = Quantity(2.0, "2 B")
    assert quantity * 3 == 6.0
    assert type(quantity * 3) is float


def test_all_quantities_are_listed_with_their_paths_in_the_order_of_the_card():
    paths = dict(machine().quantities("machine."))
    assert list(paths)[:3] == ["machine.gpu.memory", "machine.gpu.reserved_memory", "machine.gpu.memory_bandwidth"]
    assert paths["machine.pcie.uplink"] == 18e9
    assert list(paths)[-1] == "machine.host.copy_latency"
    assert len(paths) == 19


def test_cards_do_not_change_once_read():
    with pytest.raises(ValueError, match="frozen"):
        machine().gpus = 3


# Every mistake at once, each with its place


def test_a_card_with_five_mistakes_reports_all_five_in_the_order_of_the_file():
    text = changed(
        ("gpus: 2", "gpus: two"),
        ("launch_latency: 5 us", "launch_latency: 5 GB/s"),
        ("coherent_rate: 400 Mray/s\n  incoherent", "coherent_rate: -400 Mray/s\n  incoherent"),
        ('source: "others reach this", status: assumed', 'source: "others reach this", status: asumed'),
        ("latency: 2 us", "latency: 2 us\n  colour: red"),
    )
    choices = "'published', 'measured', 'derived', 'assumed', 'calibrated' or 'stated'"
    fields = "bandwidth, duplex, latency, kernel_share, switches, uplink, sockets, socket_link"
    assert mistakes(text) == [
        "m.yaml:2:7: gpus: expected a whole number, got 'two'",
        f"m.yaml:8:105: gpu.memory_bandwidth.status: expected {choices}, got 'asumed'; did you mean 'assumed'?",
        "m.yaml:9:19: gpu.launch_latency: expected a time such as '2.5 us', got a bandwidth: '5 GB/s'",
        "m.yaml:10:18: gpu.coherent_rate: must be more than 0, got '-400 Mray/s'",
        f"m.yaml:20:3: pcie.colour: unknown field (known: {fields})",
    ]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        # missing and unknown fields
        ("gpus: 2\n", "", ["m.yaml:1:1: the section gpu goes with gpus, which says how many a node has"]),
        ("gpus: 2\n", "gpus:\n", ["m.yaml:2:6: gpus: expected a whole number, got nothing"]),
        ("  latency: 2 us\n", "", ["m.yaml:17:3: pcie.latency: this field is missing"]),
        (
            "  duplex: 100 %\n",
            "  duplx: 100 %\n",
            [
                "m.yaml:17:3: pcie.duplex: this field is missing",
                "m.yaml:18:3: pcie.duplx: unknown field; did you mean 'duplex'? "
                "(known: bandwidth, duplex, latency, kernel_share, switches, uplink, sockets, socket_link)",
            ],
        ),
        # bounds
        ("gpus: 2\n", "gpus: -1\n", ["m.yaml:2:7: gpus: should be greater than or equal to 0, got -1"]),
        ("gpus: 2\n", "gpus: 2.5\n", ["m.yaml:2:7: gpus: expected a whole number, got 2.5"]),
        ("kernel_share: 0.5", "kernel_share: 0", ["m.yaml:20:17: pcie.kernel_share: must be more than 0, got 0"]),
        ("duplex: 100 %", "duplex: 101 %", ["m.yaml:18:11: pcie.duplex: must be at most 1, got '101 %'"]),
        ("memory: 1 GiB", "memory: -1 B", ["m.yaml:7:20: gpu.reserved_memory: must be at least 0, got '-1 B'"]),
        (
            "bandwidth: 25 GB/s",
            "bandwidth: nan GB/s",
            [
                "m.yaml:17:14: pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', "
                "got nan, which is not a finite number"
            ],
        ),
        (
            "rate_primitives: 1e9",
            "rate_primitives: .inf",
            [
                "m.yaml:12:20: gpu.rate_primitives: expected a number such as '8', "
                "got inf, which is not a finite number"
            ],
        ),
        # a quantity with provenance
        (
            "range: [540 GB/s, 672 GB/s]",
            "range: [570 GB/s, 672 GB/s]",
            ["m.yaml:8:21: gpu.memory_bandwidth: the value '560 GB/s' lies outside its own range"],
        ),
        (
            "range: [540 GB/s, 672 GB/s]",
            "range: [540 us, 672]",
            [
                "m.yaml:8:47: gpu.memory_bandwidth.range.0: expected a bandwidth such as '12.5 GB/s', "
                "got a time: '540 us'",
                "m.yaml:8:55: gpu.memory_bandwidth.range.1: expected a bandwidth such as '12.5 GB/s', "
                "got the number 672 without a unit",
            ],
        ),
        (
            "range: [540 GB/s, 672 GB/s]",
            "range: 132 GB/s",
            ["m.yaml:8:46: gpu.memory_bandwidth.range: expected a list, got '132 GB/s'"],
        ),
        (
            "{value: 48 GiB, source",
            "{valu: 48 GiB, source",
            [
                "m.yaml:6:11: gpu.memory.value: this field is missing",
                "m.yaml:6:12: gpu.memory.valu: unknown field; did you mean 'value'? "
                "(known: value, range, source, status)",
            ],
        ),
        (
            "memory: 1 GiB",
            "memory: [1 GiB]",
            ["m.yaml:7:20: gpu.reserved_memory: expected a size such as '16 GiB', got ['1 GiB']"],
        ),
        # sections
        (
            "host: {launch_issue: 2 us, copy_issue: 2 us, readback: 10 us}",
            "host: fast",
            [
                "m.yaml:23:7: host: expected a section with the fields launch_issue, copy_issue, readback, to_device, "
                "from_device, copy_latency, got 'fast'"
            ],
        ),
        ("pcie:\n", "pcie: &n\n", []),
        (
            "switches: [[0], [1]]",
            "switches: [[0], [2]]",
            ["m.yaml:1:1: pcie.switches must name each GPU from 0 to 1 once, got [[0], [2]]"],
        ),
        ("switches: [[0], [1]]", "switches: [0, 1]", ["m.yaml:21:14: pcie.switches.0: expected a list, got 0",
                                                  "m.yaml:21:17: pcie.switches.1: expected a list, got 1"]),
    ],
)  # fmt: skip
def test_mistakes_say_what_where_and_what_was_expected(old, new, expected):
    text = changed((old, new))
    if expected:
        assert mistakes(text) == expected
    else:
        machine(text)


def test_a_mistake_of_the_card_as_a_whole_points_to_its_beginning():
    assert mistakes(MACHINE.replace("pcie:", "host2:"))[-1].startswith("m.yaml:16:1: host2: unknown field")
    lone = MACHINE[: MACHINE.index("pcie:")] + MACHINE[MACHINE.index("host:") :]
    assert mistakes(lone) == [
        "m.yaml:1:1: a machine with several GPUs needs one of the sections nvlink and pcie, which connect them"
    ]


def test_a_long_value_is_cut_in_messages():
    (mistake,) = mistakes(changed(("gpus: 2", f"gpus: {'x' * 1000}")))
    assert mistake.endswith("x…")
    assert len(mistake) < 150


def test_a_field_that_stands_twice_is_a_mistake():
    text = changed(("gpus: 2\n", "gpus: 2\ngpus: 3\n"), ("latency: 2 us\n", "latency: 2 us\n  latency: 3 us\n"))
    assert mistakes(text) == [
        "m.yaml:3:1: gpus: this field stands twice",
        "m.yaml:21:3: pcie.latency: this field stands twice",
    ]


# YAML


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "m.yaml:1:1: a card is a mapping of fields, got nothing"),
        ("# only a comment\n", "m.yaml:1:1: a card is a mapping of fields, got nothing"),
        ("just words", "m.yaml:1:1: a card is a mapping of fields, got a single value"),
        ("- 1\n- 2\n", "m.yaml:1:1: a card is a mapping of fields, got a list"),
        ("a: [1, 2", "m.yaml:1:9: not valid YAML: expected ',' or ']', but got '<stream end>'"),
        ("a: 1\n b: 2\n", "m.yaml:2:3: not valid YAML: mapping values are not allowed here"),
        ("\ta: 1\n", "m.yaml:1:1: not valid YAML: found character '\\t' that cannot start any token"),
        ("a: @b\n", "m.yaml:1:4: not valid YAML: found character '@' that cannot start any token"),
        ("a: *b\n", "m.yaml:1:4: not valid YAML: found undefined alias 'b'"),
        (
            "a: 1\n---\nb: 2\n",
            "m.yaml:2:1: not valid YAML: expected a single document in the stream, but found another document",
        ),
        ("a: &a {b: *a}\n", "m.yaml:1:4: a.b: this value contains itself"),
        ("a: &a [1, *a]\n", "m.yaml:1:4: a.1: this value contains itself"),
        ("? [1, 2]\n: 3\n", "m.yaml:1:3: the name of a field is a word, got a list or a mapping"),
        (
            "a: !!python/name:os.system x\n",
            "m.yaml:1:4: a: cannot read 'x' as !!python/name:os.system",
        ),
        ("a: !!int x\n", "m.yaml:1:4: a: cannot read 'x' as !!int"),
        ("a: " + "[" * 5000, "m.yaml: not valid YAML: nested too deeply"),
    ],
)
def test_what_is_no_card(text, message):
    with pytest.raises(CardError) as error:
        Document(text, "m.yaml")
    assert str(error.value) == message


def test_a_control_character_is_no_yaml():
    with pytest.raises(CardError, match=r"m\.yaml: not valid YAML: unacceptable character #x0001"):
        Document("a: \x01", "m.yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e9", 1e9),  # text to YAML 1.1
        ("-1.5E+3", -1500.0),
        ("0.5", 0.5),
        (".5", 0.5),
        ("12", 12),
        ("no", "no"),  # false to YAML 1.1
        ("Yes", "Yes"),
        ("on", "on"),
        ("true", True),
        ("False", False),
        ("1:30", "1:30"),  # 90 to YAML 1.1
        ("010", "010"),  # 8 to YAML 1.1
        ("2024-13-45", "2024-13-45"),  # no date
        ("2024-12-24", "2024-12-24"),
        ("", None),
        ("~", None),
        ("null", None),
        ('"1e9"', "1e9"),
        ("<<", "<<"),
    ],
)
def test_plain_values_mean_what_they_look_like(text, value):
    read = Document(f"a: {text}", "m.yaml").data["a"]
    assert read == value
    assert type(read) is type(value)


def test_no_is_a_title_and_not_a_number():
    assert machine(changed(("title: Two GPUs", "title: no"))).title == "no"
    assert mistakes(changed(("gpus: 2", "gpus: yes"))) == ["m.yaml:2:7: gpus: expected a whole number, got 'yes'"]


def test_the_names_of_fields_are_words_whatever_they_look_like():
    assert Document("1: a\nyes: b\n2024-12-24: c\n", "m.yaml").data == {"1": "a", "yes": "b", "2024-12-24": "c"}


def test_an_anchor_can_be_used_again():
    text = changed(("latency: 2 us\n", "latency: &short 2 us\n"), ("launch_issue: 2 us", "launch_issue: *short"))
    assert machine(text).host.launch_issue == 2e-6


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1e9, "1e9"),
        (1.5e-7, "1.5e-7"),
        (123456789.0, "123456789.0"),
        (0.5, "0.5"),
        (3, "3"),
        (True, "true"),
        ("x", "x"),
    ],
)
def test_values_are_shown_as_they_are_written(value, text):
    assert written(value) == text


def test_a_number_keeps_its_looks():
    assert machine().gpu.rate_primitives.text == "1e9"


# --set


@pytest.mark.parametrize(
    ("assignment", "read", "expected"),
    [
        ("gpu.launch_latency=7 us", lambda c: c.gpu.launch_latency, 7e-6),
        ("gpu.launch_latency= 7 us ", lambda c: c.gpu.launch_latency, 7e-6),
        ("pcie.bandwidth=300 GB/s", lambda c: c.pcie.bandwidth, 300e9),
        ("gpu.rate_primitives=2e6", lambda c: c.gpu.rate_primitives, 2e6),
        ("gpu.ray_tracing_cores=false", lambda c: c.gpu.ray_tracing_cores, False),
        ("pcie.uplink=9 GB/s", lambda c: c.pcie.uplink, 9e9),
        ("nvlink=null", lambda c: c.nvlink, None),
        ("pcie.switches.0=[0]", lambda c: c.pcie.switches, [[0], [1]]),
        ("title=a=b", lambda c: c.title, "a=b"),
        ("host={launch_issue: 1 us, copy_issue: 2 us, readback: 3 us}", lambda c: c.host.readback, 3e-6),
    ],
)
def test_an_existing_value_can_be_set(assignment, read, expected):
    assert read(machine(MACHINE, assignment)) == expected


def test_a_set_that_no_longer_fits_the_rest_of_the_card_is_a_mistake_of_the_card():
    assert mistakes(MACHINE, "gpus=1") == [
        "m.yaml:1:1: pcie.switches must name each GPU from 0 to 0 once, got [[0], [1]]"
    ]


def test_a_set_value_may_bring_its_provenance():
    given = '{value: 30 GB/s, range: [20 GB/s, 40 GB/s], source: "a guess", status: assumed}'
    quantity = machine(MACHINE, f"pcie.bandwidth={given}").pcie.bandwidth
    assert (quantity, quantity.range, quantity.source) == (30e9, (20e9, 40e9), "a guess")


def test_a_set_value_is_stated_whatever_the_card_said():
    quantity = machine(MACHINE, "gpu.memory_bandwidth=600 GB/s").gpu.memory_bandwidth
    assert (quantity.status, quantity.range) == ("stated", None)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        # paths
        (
            "pci.bandwidth=1 GB/s",
            "--set machine.pci.bandwidth: machine has no field 'pci'; did you mean 'pcie'? "
            ""
            "(it has: title, nodes, gpus, gpu, cpu, nvlink, pcie, host, network, mpi, storage, display, variability, "
            "disturbances)",
        ),
        (
            "pcie.bandwith=1 GB/s",
            "--set machine.pcie.bandwith: machine.pcie has no field 'bandwith'; did you mean 'bandwidth'? "
            "(it has: bandwidth, duplex, latency, kernel_share, switches, uplink, sockets, socket_link)",
        ),
        (
            "nvlink.bandwidth=1 GB/s",
            "--set machine.nvlink.bandwidth: m.yaml has no machine.nvlink; did you mean machine.pcie.bandwidth?",
        ),
        ("pcie.bandwidth.value=1 GB/s", "--set machine.pcie.bandwidth.value: machine.pcie.bandwidth is a single value, "
                                        "without parts"),
        ("pcie.=1", "--set machine.pcie.: machine.pcie has no field '' "
                    "(it has: bandwidth, duplex, latency, kernel_share, switches, uplink, sockets, socket_link)"),
        # on a list
        (
            "pcie.switches.2=[2]",
            "--set machine.pcie.switches.2: machine.pcie.switches is a list of 2, whose parts are 0 to 1",
        ),
        (
            "pcie.switches.first=[2]",
            "--set machine.pcie.switches.first: "
            "machine.pcie.switches is a list of 2, whose parts are 0 to 1",
        ),
        ("pcie.switches.-1=[2]", "--set machine.pcie.switches.-1: "
                                       "machine.pcie.switches is a list of 2, whose parts are 0 to 1"),
        ("pcie.switches.0=2", "--set machine.pcie.switches.0: expected a list, got 2"),
        ("pcie.switches.0=[x]", "--set machine.pcie.switches.0.0: expected a whole number, got 'x'"),
        # values
        ("pcie.bandwidth=3 us", "--set machine.pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', "
                                "got a time: '3 us'"),
        ("pcie.bandwidth=3", "--set machine.pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', "
                             "got the number 3 without a unit"),
        ("pcie.bandwidth=", "--set machine.pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', got nothing"),
        ("pcie.bandwidth=[1", "--set machine.pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', got '[1'"),
        ("pcie.bandwidth=-1 GB/s", "--set machine.pcie.bandwidth: must be more than 0, got '-1 GB/s'"),
        ("pcie.bandwidth=nan GB/s", "--set machine.pcie.bandwidth: expected a bandwidth such as '12.5 GB/s', "
                                    "got nan, which is not a finite number"),
        ("pcie.kernel_share=.nan", "--set machine.pcie.kernel_share: expected a number such as '8', "
                                   "got nan, which is not a finite number"),
        ("gpus=many", "--set machine.gpus: expected a whole number, got 'many'"),
        ("gpus=-1", "--set machine.gpus: should be greater than or equal to 0, got -1"),
        ("gpu.ray_tracing_cores=perhaps", "--set machine.gpu.ray_tracing_cores: expected true or false, got 'perhaps'"),
        ("title=3", "--set machine.title: expected text, got 3"),
        ("pcie=3", "--set machine.pcie: expected a section with the fields bandwidth, duplex, latency, kernel_share, "
                   "switches, uplink, sockets, socket_link, got 3"),
        ("pcie={bandwidth: 3 GB/s, duplex: 1, latency: 1 us}",
         "--set machine.pcie.kernel_share: this field is missing"),
        ("nvlink={bandwidth: 3 GB/s, duplex: 1, latency: 1 us, kernel_share: 1}",
         "m.yaml:1:1: nvlink connects all GPUs; give its pairs, or leave one of the sections nvlink and pcie out"),
    ],
)  # fmt: skip
def test_a_bad_set_says_which_and_why(assignment, message):
    assert mistakes(MACHINE, assignment) == [message]


def test_mistakes_of_the_card_and_of_set_come_together():
    text = changed(("gpus: 2", "gpus: two"), ("latency: 2 us", "latency: 2 GB"))
    assert mistakes(text, "pcie.latency=3 GB", "pcie.duplex=7") == [
        "m.yaml:2:7: gpus: expected a whole number, got 'two'",
        "--set machine.pcie.duplex: must be at most 1, got 7",
        "--set machine.pcie.latency: expected a time such as '2.5 us', got a size: '3 GB'",
    ]


def test_the_last_of_two_sets_holds():
    assert machine(MACHINE, "pcie.latency=3 us", "pcie.latency=4 us").pcie.latency == 4e-6


# The optional sections of a workload


def workload(card, *assignments):
    return load_workload(str(card), assignments).card


def test_a_section_that_the_card_leaves_out_but_has_defaults_can_be_set(tiny_card):
    assert workload(tiny_card).bounces == workload(tiny_card, "bounces.diffuse=3").bounces
    assert workload(tiny_card, "bounces.diffuse=7").bounces.diffuse == 7
    assert workload(tiny_card, "policy.slots=4").policy == {"name": "ray_queue_cycling", "slots": 4}
    assert workload(tiny_card, "policy.name=image_parallel").policy == {"name": "image_parallel"}


def test_setting_such_a_section_leaves_other_workloads_alone(tiny_card):
    workload(tiny_card, "policy.slots=4", "bounces.diffuse=7")
    assert workload(tiny_card).policy == {"name": "ray_queue_cycling"}
    assert workload(tiny_card).bounces == WorkloadCard.model_fields["bounces"].default


def test_the_fields_of_such_a_section_are_still_checked(tiny_card):
    with pytest.raises(CardError) as error:
        workload(tiny_card, "bounces.difuse=7")
    assert str(error.value) == (
        "--set workload.bounces.difuse: workload.bounces has no field 'difuse'; did you mean 'diffuse'? "
        "(it has: diffuse, mirror, roulette)"
    )
    with pytest.raises(CardError) as error:
        workload(tiny_card, "bounces.diffuse=1000")
    assert str(error.value) == "--set workload.bounces.diffuse: should be less than or equal to 200, got 1000"


def test_a_part_of_a_vector_can_be_set(tiny_card):
    assert workload(tiny_card, "camera.position.1=-3.5").camera.position == (2.0, -3.5, 1.5)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("camera.position.3=1", "--set workload.camera.position.3: workload.camera.position is a list of 3, "
                                "whose parts are 0 to 2"),
        ("camera.position=[1, 2]", "--set workload.camera.position.2: this field is missing"),
        ("camera.position=[1, 2, 3, 4]", "--set workload.camera.position: expected 3 values, got [1, 2, 3, 4]"),
        ("camera.position.0=.nan", "--set workload.camera.position.0: should be a finite number, got nan"),
        ("camera.position=far", "--set workload.camera.position: expected a list, got 'far'"),
        ("published.resolution=64", "--set workload.published.resolution: expected WIDTHxHEIGHT in pixels such as "
                                    "'2560x1080', got 64"),
        ("published.resolution=0x36", "--set workload.published.resolution: expected WIDTHxHEIGHT in pixels such as "
                                      "'2560x1080', got '0x36'"),
        ("published.samples=1e9", "--set workload.published.samples: should be less than or equal to 65535, got 1e9"),
        ("scene.arguments.density=[1]", "--set workload.scene.arguments.density: expected a single value, got [1]"),
        ("scene.arguments=1", "--set workload.scene.arguments: expected a mapping of names to values, got 1"),
    ],
)  # fmt: skip
def test_a_bad_set_of_a_workload_says_which_and_why(tiny_card, assignment, message):
    with pytest.raises(CardError) as error:
        workload(tiny_card, assignment)
    assert str(error.value) == message


def test_a_number_among_a_generators_arguments_is_a_number(tiny_card):
    card = workload(tiny_card, "scene={generator: 'a:b', arguments: {density: 1e9, name: no, count: 3}}")
    assert card.scene.arguments == {"density": 1e9, "name": "no", "count": 3}
    assert isinstance(card.scene.arguments["density"], float)


# --set sorted by section


def test_assignments_are_sorted_by_section():
    given = ["machine.gpus=1", "policy.slots=4", "machine.nvlink.bandwidth=1 GB/s"]
    assert split_assignments(given, ("machine", "workload", "policy")) == {
        "machine": ["gpus=1", "nvlink.bandwidth=1 GB/s"], "workload": [], "policy": ["slots=4"],
    }  # fmt: skip


STARTS = "a path starts with machine. or workload. or policy."


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("gpus", "--set gpus: expected PATH=VALUE, for instance machine.nvlink.bandwidth='300 GB/s'"),
        ("machine.gpus", "--set machine.gpus: expected PATH=VALUE, for instance machine.nvlink.bandwidth='300 GB/s'"),
        ("gpus=1", f"--set gpus=1: {STARTS}, got 'gpus'"),
        ("machin.gpus=1", f"--set machin.gpus=1: {STARTS}, got 'machin.gpus'; did you mean 'machine'?"),
        ("machine.=1", f"--set machine.=1: {STARTS}, got 'machine.'; did you mean 'machine'?"),
        ("=1", f"--set =1: {STARTS}, got ''"),
    ],
)
def test_an_assignment_without_a_section_is_refused(assignment, message):
    with pytest.raises(UsageError) as error:
        split_assignments([assignment], ("machine", "workload", "policy"))
    assert str(error.value) == message


# A third party's own cards


class Shelf(Card):
    """A section with a list of quantities."""

    load: Size
    books: Count
    sizes: tuple[Size, ...] = ()


def test_quantities_in_lists_have_numbered_paths():
    shelf = Document("load: 1 kB\nbooks: 3\nsizes: [1 B, {value: 2 B, source: x, status: measured}]\n", "s").validate(
        Shelf
    )
    assert [(path, float(q)) for path, q in shelf.quantities("shelf.")] == [
        ("shelf.load", 1000.0), ("shelf.books", 3.0), ("shelf.sizes.0", 1.0), ("shelf.sizes.1", 2.0),
    ]  # fmt: skip


def test_a_card_is_read_from_a_file_by_its_path(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(MACHINE)
    assert load_machine(str(path), ["gpu.memory=24 GiB"]).gpu.memory == 24 * 2**30
    path.write_text("gpus: x\n")
    with pytest.raises(CardError) as error:
        load_machine(str(path))
    assert error.value.mistakes[0] == f"{path}:1:1: title: this field is missing"
    assert len(error.value.mistakes) == 2
