import importlib.metadata
import re
import sys

import pytest

from simrender import catalog
from simrender.cards import Document
from simrender.errors import CardError, UnknownNameError, UsageError
from simrender.policies.ray_queue_cycling import RayQueueCycling

MACHINES = {"desktop-rtx8000", "dgx2", "hgx-a100", "rtx-server-a40"}
POLICIES = {"image_parallel", "ray_queue_cycling"}


@pytest.fixture
def plug_in(monkeypatch, tmp_path):
    """A function that installs somebody's plug-in: an entry point, and the files of its package."""
    real, extra = importlib.metadata.entry_points, []

    def entry_points(*, group):
        return [*real(group=group), *(e for e in extra if e.group == group)]

    def install(group, name, value, files=None):
        for path, text in (files or {}).items():
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(text)
            monkeypatch.delitem(sys.modules, path.split("/")[0].removesuffix(".py"), raising=False)
        extra.append(importlib.metadata.EntryPoint(name, value, group))

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    before = set(sys.modules)
    yield install
    for name in set(sys.modules) - before:
        if name.startswith("somebodys_"):
            del sys.modules[name]


# Names


def test_the_machines_of_the_house_are_installed_and_sorted():
    found = catalog.cards("machine")
    assert set(found) >= MACHINES
    assert list(found) == sorted(found)
    assert all(card.path.name == "card.yaml" and card.path.is_file() for card in found.values())


def test_every_installed_card_can_be_parsed():
    for kind in ("machine", "workload"):
        for name, card in catalog.cards(kind).items():
            assert card.name == name
            assert card.document().data["title"]


def test_a_card_is_found_by_its_name():
    assert catalog.find_card("machine", "hgx-a100").path.parent.name == "hgx_a100"


def test_a_policy_is_found_by_its_name():
    assert set(catalog.policies()) >= POLICIES
    assert list(catalog.policies()) == sorted(catalog.policies())
    assert catalog.find_policy("ray_queue_cycling") is RayQueueCycling


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("dgx-2", "; did you mean 'dgx2'?"),
        ("DGX2", "; did you mean 'dgx2'?"),
        ("hgx_a100", "; did you mean 'hgx-a100'?"),
        ("xyzzy", ""),
        ("", ""),
    ],
)
def test_an_unknown_machine_says_what_is_near_and_what_there_is(name, hint):
    with pytest.raises(UnknownNameError) as error:
        catalog.find_card("machine", name)
    assert str(error.value) == f"unknown machine {name!r}{hint} (known: {', '.join(catalog.cards('machine'))})"


def test_an_unknown_policy_says_what_is_near_and_what_there_is():
    with pytest.raises(UnknownNameError) as error:
        catalog.find_policy("ray_queue_cycle")
    known = ", ".join(catalog.policies())
    assert str(error.value) == f"unknown policy 'ray_queue_cycle'; did you mean 'ray_queue_cycling'? (known: {known})"


def test_where_nothing_is_installed_the_message_says_so(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: [])
    with pytest.raises(UnknownNameError, match=r"^unknown workload 'island' \(known: none\)$"):
        catalog.find_card("workload", "island")


# Paths


def test_a_card_is_found_by_its_path_and_named_after_its_file_or_folder(tmp_path):
    for path, name in (("mine.yaml", "mine"), ("theirs.yml", "theirs"), ("big_node/card.yaml", "big_node")):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text("title: x\n")
        found = catalog.find_card("machine", str(tmp_path / path))
        assert (found.name, found.path) == (name, tmp_path / path)
        assert found.document().data == {"title": "x"}


def test_a_path_without_a_folder_is_a_path_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "node").write_text("title: x\n")
    (tmp_path / "card.yaml").write_text("title: y\n")
    assert catalog.find_card("machine", "node").document().data == {"title": "x"}
    assert catalog.find_card("machine", "card.yaml").name == tmp_path.name


def test_a_name_wins_over_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dgx2").mkdir()
    assert catalog.find_card("machine", "dgx2").document().data["gpus"] == 16


@pytest.mark.parametrize("name", ["nowhere/card.yaml", "nowhere.yaml"])
def test_a_path_that_leads_nowhere(name):
    with pytest.raises(UnknownNameError) as error:
        catalog.find_card("workload", name)
    assert str(error.value).startswith(f"unknown workload {name!r} (known: ")
    assert str(error.value).endswith("; there is no such file either")


def test_a_folder_is_no_card(tmp_path):
    with pytest.raises(UsageError) as error:
        catalog.find_card("machine", str(tmp_path))
    expected = f"expected the card of a machine, such as {tmp_path / 'card.yaml'}"
    assert str(error.value) == f"{tmp_path}: this is a folder, {expected}"


def test_a_file_of_another_kind_is_no_card():
    with pytest.raises(UsageError) as error:
        catalog.find_card("machine", "node.json")
    assert str(error.value) == "node.json: expected the card of a machine, a file that ends in .yaml or .yml"
    with pytest.raises(UsageError) as error:
        catalog.find_card("workload", "scene.usd")
    assert str(error.value).startswith(
        "scene.usd: expected the card of a workload, a file that ends in .yaml or .yml; a scene ends in .ply, .obj, "
    )


def test_the_hint_about_scenes_names_every_format():
    from simrender.rays.files import FORMATS

    with pytest.raises(UsageError) as error:
        catalog.find_card("workload", "scene.usd")
    assert all(ending in str(error.value) for ending in FORMATS)


def test_a_card_that_is_not_text(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CardError) as error:
        catalog.find_card("machine", str(path)).document()
    assert str(error.value) == f"{path}: cannot read this card: is not a text file"


def test_a_card_that_vanishes_before_it_is_read(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text("title: x\n")
    found = catalog.find_card("machine", str(path))
    path.unlink()
    with pytest.raises(CardError) as error:
        found.document()
    assert str(error.value) == f"{path}: cannot read this card: No such file or directory"


# Plug-ins


def test_somebodys_cards_stand_beside_our_own(plug_in):
    plug_in("simrender.machines", "theirs", "somebodys_nodes", {
        "somebodys_nodes/__init__.py": "", "somebodys_nodes/old_node/card.yaml": "title: An old node\n",
        "somebodys_nodes/notes.txt": "no card",
    })  # fmt: skip
    found = catalog.cards("machine")
    assert set(found) >= MACHINES | {"old-node"}
    document = catalog.find_card("machine", "old-node").document()
    assert isinstance(document, Document)
    assert document.data["title"] == "An old node"


def test_two_cards_of_one_name_are_refused(plug_in):
    plug_in("simrender.machines", "theirs", "somebodys_twin", {
        "somebodys_twin/__init__.py": "", "somebodys_twin/dgx2/card.yaml": "title: Another\n",
    })  # fmt: skip
    with pytest.raises(UsageError, match=r"^two machines are called 'dgx2': .*dgx2/card\.yaml and .*dgx2/card\.yaml$"):
        catalog.cards("machine")


def test_one_package_under_two_entry_points_is_no_duplicate(plug_in):
    plug_in("simrender.machines", "again", "hardware_models")
    assert set(catalog.cards("machine")) >= MACHINES


@pytest.mark.parametrize(
    ("value", "files", "reason"),
    [
        ("somebodys_missing", {}, "No module named 'somebodys_missing'"),
        ("somebodys_typo", {"somebodys_typo/__init__.py": "def (:\n"}, "invalid syntax"),
        ("somebodys_crash", {"somebodys_crash/__init__.py": "raise OSError('no\\n  licence')"}, "no licence"),
        ("somebodys_exit", {"somebodys_exit/__init__.py": "raise ValueError"}, "ValueError"),
        ("somebodys_module", {"somebodys_module.py": ""}, "has no attribute '__path__'"),
    ],
)
def test_a_broken_package_of_cards_only_warns(plug_in, value, files, reason):
    plug_in("simrender.machines", "broken", value, files)
    with pytest.warns(UserWarning, match=f"machines of '{value}' are left out: .*{reason}"):
        found = catalog.cards("machine")
    assert set(found) >= MACHINES


def test_somebodys_policy_is_found_and_imported_only_then(plug_in):
    plug_in("simrender.policies", "theirs", "somebodys_policy:Theirs", {
        "somebodys_policy.py": "class Theirs:\n    '''Theirs.'''\n",
    })  # fmt: skip
    assert set(catalog.policies()) >= POLICIES | {"theirs"}
    assert "somebodys_policy" not in sys.modules
    assert catalog.find_policy("theirs").__name__ == "Theirs"


def test_two_policies_of_one_name_are_refused(plug_in):
    plug_in("simrender.policies", "image_parallel", "somebodys_policy:Theirs")
    ours = "simrender.policies.image_parallel:ImageParallel"
    with pytest.raises(UsageError) as error:
        catalog.policies()
    assert str(error.value) == f"two policies are called 'image_parallel': {ours} and somebodys_policy:Theirs"


def test_a_broken_policy_fails_only_when_it_is_asked_for(plug_in):
    plug_in("simrender.policies", "broken", "somebodys_wreck:Policy")
    assert catalog.find_policy("ray_queue_cycling") is RayQueueCycling
    with pytest.raises(UsageError) as error:
        catalog.find_policy("broken")
    assert str(error.value) == (
        "the policy 'broken' (somebodys_wreck:Policy) cannot be loaded: No module named 'somebodys_wreck'"
    )


def test_a_broken_plug_in_hides_nothing_else_from_the_list(plug_in, run_cli):
    plug_in("simrender.policies", "broken", "somebodys_wreck:Policy")
    plug_in("simrender.machines", "missing", "somebodys_missing")
    plug_in("simrender.machines", "theirs", "somebodys_nodes", {
        "somebodys_nodes/__init__.py": "", "somebodys_nodes/bad_node/card.yaml": "title: [\n",
        "somebodys_nodes/odd_node/card.yaml": "title: Odd [/bold] node\n",
    })  # fmt: skip
    ran = run_cli("list")
    assert ran.code == 0
    assert all(name in ran.out for name in MACHINES | POLICIES)
    assert "Odd [/bold] node" in ran.out
    notes = ran.err.splitlines()
    assert [note.split(":")[0] for note in notes] == ["note"] * 3
    assert "machines of 'somebodys_missing' are left out" in notes[0]
    assert "bad_node/card.yaml:2:1: not valid YAML" in notes[1]
    assert "the policy 'broken' (somebodys_wreck:Policy) cannot be loaded" in notes[2]


def test_the_variants_of_a_card_are_listed_below_it(plug_in, run_cli):
    plug_in("simrender.machines", "theirs", "somebodys_nodes", {
        "somebodys_nodes/__init__.py": "",
        "somebodys_nodes/new_node/card.yaml": "extends: dgx2\nvariants: {slow: {title: Slow}, odd: {gpus: 1}}\n",
        "somebodys_nodes/bad_node/card.yaml": "title: Bad\nvariants: {slow: 3}\n",
        "somebodys_nodes/lost_node/card.yaml": "extends: dgx3\n",
    })  # fmt: skip
    ran = run_cli("list", "machines")
    assert ran.code == 0
    title = "NVIDIA DGX-2 (16 V100 32 GB, NVSwitch), as changed by new-node"
    lines = [re.split(" {2,}", line.rstrip(), maxsplit=1) for line in ran.out.splitlines()]
    assert lines[lines.index(["new-node", title]) + 1 :][:2] == [
        ["new-node:slow", "Slow"], ["new-node:odd", f"{title}, variant odd"],
    ]  # fmt: skip
    assert ["bad-node", "broken"] in lines
    assert ["lost-node", "broken"] in lines
    notes = ran.err.splitlines()
    expected = "expected a mapping of the fields that differ, got 3"
    assert notes[0].endswith(f"bad_node/card.yaml:2:18: variants.slow: {expected}")
    assert "lost_node/card.yaml:1:10: extends: unknown machine 'dgx3'; did you mean 'dgx2'? (known: " in notes[1]


# Generators


def test_a_function_is_loaded_by_its_reference():
    assert catalog.load_function("math:sqrt", "here")(9.0) == 3.0


@pytest.mark.parametrize(
    ("reference", "reason"),
    [
        ("nosuch_module:f", "No module named 'nosuch_module'"),
        ("math:nosuch", "module 'math' has no attribute 'nosuch'"),
        ("math", "module 'math' has no attribute ''"),
        (":f", "Empty module name"),
        (".relative:f", "the 'package' argument is required to perform a relative import for '.relative'"),
    ],
)
def test_a_reference_to_no_function_is_a_mistake_of_the_card(reference, reason):
    with pytest.raises(CardError) as error:
        catalog.load_function(reference, "card.yaml: scene.generator")
    expected = f"cannot load {reference!r} (written as package.module:function): {reason}"
    assert str(error.value) == f"card.yaml: scene.generator: {expected}"
