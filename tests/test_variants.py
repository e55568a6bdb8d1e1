"""Cards that extend other cards, and their variants: what holds, where it was written, and what goes wrong."""

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from simrender import catalog
from simrender.cards import Card, Count, Document, Duration, Size
from simrender.errors import CardError, UnknownNameError
from simrender.hardware.machine import load_machine
from simrender.rays.workload import load_workload

BASE = """\
title: Base
gpus: 2
gpu:
  memory: {value: 48 GiB, range: [40 GiB, 48 GiB], source: "a table", status: published}
  latency: 5 us
link:
  latency: 2 us
  width: 16
groups: [[0], [1]]
variants:
  big: {gpus: 4, gpu: {memory: 96 GiB}}
  bus:
    title: Base on a bus
    link: null
    bus: {latency: 9 us, width: 1}
"""


class Gpu(Card):
    memory: Size
    latency: Duration


class Fabric(Card):
    latency: Duration
    width: Count


class Node(Card):
    """A small machine, for which these tests do not change when the models of machines do."""

    title: str
    gpus: int
    gpu: Gpu
    link: Fabric | None = None
    bus: Fabric | None = None
    groups: list[list[int]] = Field(default_factory=list)


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """A function that writes a card into the working folder; base.yaml is there."""
    monkeypatch.chdir(tmp_path)

    def write(name, text):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
        return name

    write("base.yaml", BASE)
    return write


def read(name):
    return catalog.find_card("machine", name).document()


def node(name):
    return read(name).validate(Node)


def mistakes(name, model=Node):
    with pytest.raises(CardError) as error:
        read(name).validate(model)
    return list(error.value.mistakes)


# What holds


def test_a_card_says_only_what_differs(shelf):
    shelf("mine.yaml", "extends: base.yaml\ntitle: Mine\ngpu: {latency: 7 us}\ngroups: [[0, 1]]\n")
    mine, base = node("mine.yaml"), node("base.yaml")
    assert (mine.title, mine.gpus, mine.gpu.latency, mine.groups) == ("Mine", 2, 7e-6, [[0, 1]])
    assert mine.gpu.memory == base.gpu.memory
    assert mine.gpu.memory.range == base.gpu.memory.range == (40 * 2**30, 48 * 2**30)
    assert mine.link == base.link


def test_a_plain_value_replaces_one_with_provenance_and_the_other_way_round(shelf):
    shelf("mine.yaml", "extends: base.yaml\ngpu: {memory: 8 GiB, latency: {value: 1 us, status: measured}}\n")
    gpu = node("mine.yaml").gpu
    assert (gpu.memory, gpu.memory.status, gpu.memory.range) == (8 * 2**30, "stated", None)
    assert (gpu.latency, gpu.latency.status) == (1e-6, "measured")


def test_a_value_with_provenance_replaces_another_as_a_whole(shelf):
    shelf("mine.yaml", "extends: base.yaml\ngpu: {memory: {value: 8 GiB, status: assumed}}\n")
    memory = node("mine.yaml").gpu.memory
    assert (memory, memory.status, memory.source, memory.range) == (8 * 2**30, "assumed", "", None)


def test_null_takes_a_section_away(shelf):
    shelf("mine.yaml", "extends: base.yaml\nlink: null\nbus: {latency: 1 us, width: 2}\n")
    document = read("mine.yaml")
    assert "link" not in document.data
    assert not any(path[:1] == ("link",) for path in document.keys)
    assert document.validate(Node).link is None


def test_null_takes_a_default_back(shelf):
    shelf("mine.yaml", "extends: base.yaml\ngroups: null\n")
    assert node("mine.yaml").groups == []


def test_an_empty_card_is_its_parent_by_another_title(shelf):
    shelf("mine.yaml", "extends: base.yaml\n")
    assert node("mine.yaml") == node("base.yaml").model_copy(update={"title": "Base, as changed by mine"})


def test_a_card_can_extend_one_that_extends_another(shelf):
    shelf("a/card.yaml", "extends: ../base.yaml\ngpus: 3\nlink: {width: 8}\n")
    shelf("b.yaml", "extends: a/card.yaml\nlink: {latency: 1 us}\n")
    b = node("b.yaml")
    assert (b.title, b.gpus) == ("Base, as changed by a, as changed by b", 3)
    assert (b.link.latency, b.link.width, b.gpu.latency) == (1e-6, 8.0, 5e-6)


def test_a_path_begins_at_the_cards_own_folder(shelf, tmp_path, monkeypatch):
    shelf("deep/down/mine.yaml", "extends: ../../base.yaml\ngpus: 9\n")
    shelf("deep/down/next", "extends: mine.yaml\n")
    shelf("deep/down/last.yaml", "extends: next\n")  # a file without an ending, in the same folder
    monkeypatch.chdir("/")
    assert node(str(tmp_path / "deep/down/last.yaml")).gpus == 9


def test_an_installed_card_can_be_extended_by_its_name(shelf):
    shelf("mine.yaml", "extends: dgx2\nnvlink: {bandwidth: 300 GB/s}\n")
    mine, dgx2 = load_machine("mine.yaml"), load_machine("dgx2")
    assert mine.nvlink.bandwidth == 300e9
    assert mine.nvlink.latency == dgx2.nvlink.latency
    assert mine.gpu == dgx2.gpu
    assert mine.title == f"{dgx2.title}, as changed by mine"


def test_a_set_changes_an_inherited_value(shelf):
    shelf("mine.yaml", "extends: dgx2\nnvlink: {bandwidth: 300 GB/s}\n")
    assert load_machine("mine.yaml", ["nvlink.latency=7 us"]).nvlink.latency == 7e-6
    shelf("less.yaml", "extends: dgx2\nnvlink: null\n")
    with pytest.raises(CardError) as error:
        load_machine("less.yaml", ["nvlink.bandwidth=1 GB/s"])
    message = "less.yaml has no machine.nvlink; did you mean machine.storage.local.bandwidth?"
    assert str(error.value) == f"--set machine.nvlink.bandwidth: {message}"


# Workloads


def test_a_workload_extends_another_whose_mesh_lies_elsewhere(shelf, tiny_card):
    shelf("else/mine.yaml", f"extends: {tiny_card}\npublished: {{samples: 1}}\n")
    shelf("next.yaml", "extends: else/mine.yaml\n")
    mine = load_workload("next.yaml")
    assert (mine.name, mine.card.published.samples) == ("next", 1)
    assert mine.scene.unique_triangles == load_workload(str(tiny_card)).scene.unique_triangles == 288


def test_a_workloads_variant_brings_its_policy(shelf, tiny_card):
    tiny_card.write_text(f"{tiny_card.read_text()}variants: {{whole: {{policy: {{name: image_parallel}}}}}}\n")
    whole = load_workload(f"{tiny_card}:whole")
    assert whole.name == "tiny:whole"
    assert whole.card.policy == {"name": "image_parallel"}
    assert whole.folder == tiny_card.parent
    policy = whole.document.section("policy", whole.card.policy)
    assert policy.position(("name",)) == f"{tiny_card}:6:35"
    assert load_workload(str(tiny_card)).card.policy == {"name": "ray_queue_cycling"}


# Variants


def test_a_variant_changes_its_card(shelf):
    big, bus, base = node("base.yaml:big"), node("base.yaml:bus"), node("base.yaml")
    assert (big.title, big.gpus, big.gpu.memory, big.gpu.latency) == ("Base, variant big", 4, 96 * 2**30, 5e-6)
    assert (bus.title, bus.link, bus.bus.latency) == ("Base on a bus", None, 9e-6)
    assert (base.gpus, base.gpu.memory, base.bus) == (2, 48 * 2**30, None)


def test_a_card_knows_its_variants_and_a_variant_has_none(shelf):
    assert list(read("base.yaml").variants) == ["big", "bus"]
    assert read("base.yaml:big").variants == {}
    assert catalog.find_card("machine", "base.yaml:big").name == "base:big"


def test_variants_are_inherited_and_can_be_changed_and_taken_away(shelf):
    variants = "{big: {gpu: {latency: 1 us}}, bus: null, own: {gpus: 5}}"
    shelf("mine.yaml", f"extends: base.yaml\ngpus: 3\nvariants: {variants}\n")
    assert list(read("mine.yaml").variants) == ["big", "own"]
    big = node("mine.yaml:big")
    assert (big.gpus, big.gpu.memory, big.gpu.latency) == (4, 96 * 2**30, 1e-6)
    assert node("mine.yaml:own").gpus == 5
    assert node("mine.yaml").gpus == 3


def test_a_card_can_extend_a_variant_and_then_inherits_no_other(shelf):
    shelf("mine.yaml", "extends: base.yaml:bus\nbus: {width: 3}\n")
    mine = read("mine.yaml")
    assert mine.variants == {}
    card = mine.validate(Node)
    assert card.title == "Base on a bus, as changed by mine"
    assert (card.link, card.bus.latency, card.bus.width) == (None, 9e-6, 3.0)


def test_a_set_of_the_card_leaves_its_variants_alone(shelf):
    document = read("base.yaml")
    document.override(Node, "link=null", "machine")
    document.override(Node, "groups.0=[7]", "machine")
    assert document.validate(Node).groups == [[7], [1]]
    assert document.variants["big"].data["groups"] == [[0], [1]]
    assert document.variants["big"].validate(Node).link is not None


def test_a_file_may_have_a_colon_in_its_name(shelf):
    shelf("odd:name.yaml", "extends: base.yaml\ngpus: 6\n")
    shelf("fold:er/card.yaml", "extends: ../base.yaml:big\n")
    assert node("odd:name.yaml").gpus == 6
    assert node("fold:er/card.yaml").gpus == 4


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("base.yaml:bigg", "unknown variant of base 'bigg'; did you mean 'big'? (known: big, bus)"),
        ("base.yaml:", "unknown variant of base '' (known: big, bus)"),
        ("dgx3:big", "unknown machine 'dgx3'; did you mean 'dgx2'? (known: "),
    ],
)
def test_an_unknown_variant_says_what_is_near_and_what_there_is(shelf, name, message):
    with pytest.raises(UnknownNameError) as error:
        read(name)
    assert str(error.value).startswith(message)


# Where it was written


def test_every_value_says_where_it_was_written_and_by_which_card(shelf):
    shelf("mine.yaml", "extends: base.yaml\nlink: {width: 8}\nvariants: {wide: {link: {width: 32}}}\n")
    document, wide = read("mine.yaml"), read("mine.yaml:wide")
    assert document.position(("link", "width")) == "mine.yaml:2:15"
    assert document.position(("link", "latency")) == "base.yaml:7:12"
    assert document.position(("link",)) == "mine.yaml:2:7"
    assert document.position(()) == "mine.yaml:1:1"
    assert document.position(("gpu", "memory", "status")) == "base.yaml:4:79"
    assert [document.origin(("link", field)) for field in ("width", "latency")] == ["mine", "base"]
    assert wide.position(("link", "width")) == "mine.yaml:3:33"
    assert [wide.origin(p) for p in (("link", "width"), ("link", "latency"))] == ["mine:wide", "base"]
    assert read("mine.yaml:big").origin(("gpus",)) == "base:big"
    shelf("next.yaml", "extends: mine.yaml:wide\n")
    document = read("next.yaml")
    assert [document.origin(p) for p in (("link", "width"), ("link", "latency"))] == ["mine:wide", "base"]


words = st.sampled_from("abc")
values = st.one_of(st.integers(0, 9), st.none(), st.lists(st.integers(0, 9), max_size=2),
                   st.builds(lambda v: {"value": v, "status": "stated"}, st.integers(0, 9)))  # fmt: skip
sections = st.recursive(values, lambda inner: st.dictionaries(words, inner, max_size=3), max_leaves=9)
cards = st.dictionaries(words, sections, max_size=3)


def leaves(value, path=()):
    if isinstance(value, dict) and value and "value" not in value:
        return {p: v for name, inner in value.items() for p, v in leaves(inner, (*path, name)).items()}
    return {path: value}


def at(data, path):
    for part in path:
        data = data[part]
    return data


@settings(deadline=None, derandomize=True, max_examples=50)
@given(cards, cards)
def test_each_value_is_that_of_the_upper_card_or_else_of_the_lower(upper, lower):
    documents = {"upper": upper, "lower": lower}
    parsed = {name: Document(yaml.safe_dump(data), f"{name}.yaml", name) for name, data in documents.items()}
    merged = parsed["upper"].over(parsed["lower"])
    assert parsed["lower"].data == lower
    assert parsed["upper"].data == upper
    for path, value in leaves(merged.data).items():
        if not path or value == {}:
            continue
        name = merged.origin(path)
        assert at(documents[name], path) == value
        assert merged.positions[path] == parsed[name].positions[path]
        assert merged.position(path).startswith(f"{name}.yaml:")
    said = leaves(upper)
    for path, value in said.items():
        if path and value not in (None, {}):
            assert at(merged.data, path) == value
    for path, value in leaves(lower).items():
        hidden = any(path[:n] in said for n in range(len(path) + 1)) or any(path == p[: len(path)] for p in said)
        if not hidden and value != {}:
            assert at(merged.data, path) == value


@settings(deadline=None, derandomize=True, max_examples=50)
@given(cards)
def test_nothing_over_a_card_and_a_card_over_nothing_are_that_card(data):
    document, empty = Document(yaml.safe_dump(data), "m.yaml"), Document("{}", "empty.yaml")
    assert empty.over(document).data == data
    assert document.over(empty).data == data
    assert empty.over(document).positions == {**document.positions, (): "empty.yaml:1:1"}


# Every mistake at once, each with its place


def test_five_mistakes_of_one_machine(shelf):
    dgx2 = catalog.find_card("machine", "dgx2").path.read_text()
    text = "title: Five\n" + dgx2[dgx2.index("gpus:") :]
    for old, new in (
        ("gpus: 16", "gpus: 16\ncolour: red"),
        ("  launch_latency: {value: 5.32 us", "  launch_latency: {value: 5.32 GB"),
        ("  duplex: {value: 0.927, range: [0.920, 0.943]", "  duplex: {value: 1.927, range: [0.920, 0.943]"),
        ("  bandwidth: {value: 145.57 GB/s", "  bandwith: {value: 145.57 GB/s"),
        ('GPU column", status: measured', 'GPU column", status: mesured'),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    shelf("five.yaml", text)
    with pytest.raises(CardError) as error:
        load_machine("five.yaml")
    rows = text.splitlines()
    first = {row.split(":")[0]: i + 1 for i, row in reversed(list(enumerate(rows)))}
    lines = [int(mistake.split(":")[1]) for mistake in error.value.mistakes]
    assert lines == [
        first["colour"], first["  launch_latency"], first["nvlink"] + 1, first["  bandwith"], first["  duplex"],
        first["  latency"],
    ]  # fmt: skip
    colour, launch, missing, unknown, duplex, status = error.value.mistakes
    assert colour.startswith("five.yaml:3:1: colour: unknown field (known: title, ")
    assert launch.endswith(": gpu.launch_latency.value: expected a time such as '2.5 us', got a size: '5.32 GB'")
    assert missing.endswith(":3: nvlink.bandwidth: this field is missing")
    assert ":3: nvlink.bandwith: unknown field; did you mean 'bandwidth'? (known: bandwidth, " in unknown
    assert duplex.endswith(": nvlink.duplex.value: must be at most 1, got 1.927")
    assert ": nvlink.latency.status: expected 'published', " in status
    assert status.endswith(", got 'mesured'; did you mean 'measured'?")


BROKEN_BASE = """\
title: Base
gpus: two
gpu:
  memory: {value: 48 GB/s, status: published}
link:
  latency: 2 us
  width: -1
"""

BROKEN_MINE = """\
extends: base.yaml
gpu:
  latency: {value: 5 us, status: guessed}
link: {latensy: 3 us}
bus: {latency: 1 us}
variants:
  big:
    gpus: many
    gpu: {memory: [1, 2]}
    bus: {width: wide}
  own: {colour: red}
"""


def test_mistakes_of_parent_child_and_variants_come_together(shelf):
    shelf("base.yaml", BROKEN_BASE)
    shelf("mine.yaml", BROKEN_MINE)
    statuses = "'published', 'measured', 'derived', 'assumed', 'calibrated' or 'stated'"
    known = "title, gpus, gpu, link, bus, groups"
    base = [
        "base.yaml:2:7: gpus: expected a whole number, got 'two'",
        "base.yaml:4:19: gpu.memory.value: expected a size such as '16 GiB', got a bandwidth: '48 GB/s'",
        "base.yaml:7:10: link.width: must be more than 0, got -1",
    ]
    mine = [
        f"mine.yaml:3:34: gpu.latency.status: expected {statuses}, got 'guessed'; did you mean 'assumed'?",
        "mine.yaml:4:8: link.latensy: unknown field; did you mean 'latency'? (known: latency, width)",
        "mine.yaml:5:6: bus.width: this field is missing",
    ]
    big = [
        "mine.yaml:8:11: variants.big.gpus: expected a whole number, got 'many'",
        "mine.yaml:9:19: variants.big.gpu.memory: expected a size such as '16 GiB', got [1, 2]",
        "mine.yaml:10:18: variants.big.bus.width: expected a number such as '8', got 'wide'",
    ]
    own = [f"mine.yaml:11:9: variants.own.colour: unknown field (known: {known})"]
    assert mistakes("mine.yaml") == [*mine, *big, *own, *base]
    assert mistakes("mine.yaml:own") == [*mine, *own, *base]
    assert mistakes("base.yaml") == [base[0], "base.yaml:4:3: gpu.latency: this field is missing", *base[1:]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("gpu: null\n", ["mine.yaml:2:6: gpu: this field is missing"]),
        ("gpu: 3\n", ["mine.yaml:2:6: gpu: expected a section with the fields memory, latency, got 3"]),
        ("gpu: {memory: {status: assumed}}\n", ["mine.yaml:2:15: gpu.memory.value: this field is missing"]),
        ("title: null\n", ["mine.yaml:2:8: title: this field is missing"]),
        ("nolink: null\n", ["mine.yaml:2:1: nolink: unknown field; did you mean 'link'? "
                            "(known: title, gpus, gpu, link, bus, groups)"]),
        ("variant: {}\n", ["mine.yaml:2:1: variant: unknown field; did you mean 'variants'? "
                           "(known: title, gpus, gpu, link, bus, groups)"]),
        # variants that are none
        ("variants: 3\n", ["mine.yaml:2:11: variants: expected a mapping of names to the fields that differ, got 3"]),
        ("variants: {a: 3, b: }\n", [
            "mine.yaml:2:15: variants.a: expected a mapping of the fields that differ, got 3",
            "mine.yaml:2:20: variants.b: expected a mapping of the fields that differ, got nothing",
        ]),
        ("variants: {'a b': {}, 'c:d': {}}\n", [
            "mine.yaml:2:12: variants.a b: the name of a variant has no blank, colon or slash",
            "mine.yaml:2:23: variants.c:d: the name of a variant has no blank, colon or slash",
        ]),
        ("gpus: x\nvariants: {a: 3}\n", [
            "mine.yaml:2:7: gpus: expected a whole number, got 'x'",
            "mine.yaml:3:15: variants.a: expected a mapping of the fields that differ, got 3",
        ]),
        # a variant says only what its card may say
        ("variants: {a: {extends: dgx2}}\n", ["mine.yaml:2:16: variants.a.extends: unknown field "
                                              "(known: title, gpus, gpu, link, bus, groups)"]),
        ("variants: {a: {gpu: null}}\n", ["mine.yaml:2:21: variants.a.gpu: this field is missing"]),
        ("variants: {a: {bus: {width: 1}}}\n", ["mine.yaml:2:21: variants.a.bus.latency: this field is missing"]),
    ],
)  # fmt: skip
def test_mistakes_say_what_where_and_what_was_expected(shelf, text, expected):
    shelf("mine.yaml", f"extends: base.yaml\n{text}")
    assert mistakes("mine.yaml") == expected


def test_a_mistake_of_a_section_that_a_variant_changes_is_reported_once(shelf):
    shelf("base.yaml", BASE.replace("  latency: 5 us\n", "").replace("width: 16", "width: wide"))
    assert mistakes("base.yaml") == [
        "base.yaml:4:3: gpu.latency: this field is missing",
        "base.yaml:7:10: link.width: expected a number such as '8', got 'wide'",
    ]


def test_a_variant_that_breaks_its_machine_is_found_where_it_is_written(shelf):
    shelf("mine.yaml", "extends: dgx2\nvariants:\n  bare: {nvlink: null}\n  tiny: {gpu: {memory: 1 GiB}}\n")
    with pytest.raises(CardError) as error:
        load_machine("mine.yaml")
    bare, tiny = error.value.mistakes
    assert bare.startswith("mine.yaml:3:9: variants.bare: ")
    assert tiny == (
        "mine.yaml:4:15: variants.tiny.gpu: reserved_memory (1 GiB) leaves nothing of memory (1 GiB)"
    )  # fmt: skip


def test_an_inherited_variant_that_no_longer_fits_is_a_mistake_when_it_is_used(shelf):
    shelf("base.yaml", f"{BASE}  wide: {{link: {{width: 32}}}}\n")
    shelf("mine.yaml", "extends: base.yaml\nlink: null\n")
    assert node("mine.yaml").link is None
    assert mistakes("mine.yaml:wide") == ["base.yaml:16:16: variants.wide.link.latency: this field is missing"]


def test_a_broken_variant_that_is_asked_for_says_what_is_wrong(shelf):
    shelf("mine.yaml", "extends: base.yaml\nvariants: {a: 3}\n")
    assert mistakes("mine.yaml:a") == [
        "mine.yaml:2:15: variants.a: expected a mapping of the fields that differ, got 3"
    ]


# Parents that are none


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("dgx3", "unknown machine 'dgx3'; did you mean 'dgx2'? (known: {machines})"),
        ("nowhere.yaml", "unknown machine 'nowhere.yaml' (known: {machines}); there is no such file either"),
        ("base.yaml:bigg", "unknown variant of base 'bigg'; did you mean 'big'? (known: big, bus)"),
        ("island", "'island' is a workload, expected a machine"),
        ("notes.txt", "notes.txt: expected the card of a machine, a file that ends in .yaml or .yml"),
        ("scene.yaml", "scene.yaml is the card of a workload, expected that of a machine"),
        ("3", "expected the name or the path of a card, got 3"),
        ("[a, b]", "expected the name or the path of a card, got ['a', 'b']"),
        ("", "expected the name or the path of a card, got nothing"),
        ("mine.yaml", "the cards extend one another in a circle: mine extends mine"),
        ("mine.yaml:big", "the cards extend one another in a circle: mine extends mine"),
    ],
)
def test_a_parent_that_is_none(shelf, reference, message):
    shelf("scene.yaml", "title: x\nscene: {file: x.ply}\n")
    shelf("mine.yaml", f"title: Mine\nextends: {reference}\n")
    column = 10 if reference else 9
    expected = message.format(machines=", ".join(catalog.cards("machine")))
    assert mistakes("mine.yaml") == [f"mine.yaml:2:{column}: extends: {expected}"]


def test_a_workload_extends_no_machine(shelf):
    shelf("mine.yaml", "extends: dgx2\nscene: {file: x.ply}\n")
    with pytest.raises(CardError) as error:
        load_workload("mine.yaml")
    assert str(error.value) == "mine.yaml:1:10: extends: 'dgx2' is a machine, expected a workload"


def test_a_longer_circle_is_named_in_full(shelf):
    shelf("start.yaml", "extends: a.yaml\n")
    shelf("a.yaml", "gpus: 1\nextends: b.yaml\n")
    shelf("b.yaml", "extends: sub/../a.yaml\n")
    shelf("sub/x", "")
    assert mistakes("start.yaml") == [
        "b.yaml:1:10: extends: the cards extend one another in a circle: a extends b extends a"
    ]


def test_a_parent_that_is_no_yaml_says_so_itself(shelf):
    shelf("base.yaml", "title: [\n")
    shelf("mine.yaml", "extends: base.yaml\n")
    assert mistakes("mine.yaml")[0].startswith("base.yaml:2:1: not valid YAML: ")


def test_a_grandparent_that_is_none_is_the_parents_mistake(shelf):
    shelf("a.yaml", "extends: dgx3\n")
    shelf("b.yaml", "extends: a.yaml\n")
    assert mistakes("b.yaml")[0].startswith("a.yaml:1:10: extends: unknown machine 'dgx3'; did you mean 'dgx2'?")


# What is installed


@pytest.mark.parametrize("kind", ["machine", "workload"])
def test_every_variant_of_every_installed_card_holds(kind):
    load = load_machine if kind == "machine" else load_workload
    for name, card in catalog.cards(kind).items():
        assert catalog.kind_of(card.document().data) == kind
        for variant in card.document().variants:
            load(f"{name}:{variant}")
