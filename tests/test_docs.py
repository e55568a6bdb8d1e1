"""The documentation, tried as a newcomer would: its files are written, its commands run, its messages compared."""

import re
import shlex
from pathlib import Path

import pytest

from simrender.cli import main

PAGES = sorted((Path(__file__).parents[1] / "docs").glob("*.md"))
SMALL = ["--set", "workload.traced.resolution=64x27"]


def files(text):
    return {block[1]: block[0] for block in re.findall(r"```\w+\n(# (\S+)\n.*?)```", text, re.DOTALL)}


def commands(text):
    return [shlex.split(line, comments=True)[1:] for line in re.findall(r"^    (simrender .*)$", text, re.MULTILINE)
            if not line.startswith("simrender: ")]  # fmt: skip


def test_there_are_pages():
    assert [page.name for page in PAGES] == ["write-a-machine-card.md", "write-a-workload-card.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_true(page, tmp_path, monkeypatch, capsys):
    text = page.read_text()
    monkeypatch.chdir(tmp_path)
    for name, content in files(text).items():
        (tmp_path / name).write_text(content)
    told = re.search(r"^    simrender: (.*\n(?:    .+\n)*)", text, re.MULTILINE)
    for command in commands(text):
        with pytest.raises(SystemExit) as status:
            main([*command, *(SMALL if command[0] in {"run", "trace"} else [])])
        printed, complaints = capsys.readouterr()
        if "wrong.yaml" in command:
            assert status.value.code == 2
            expected = [line.strip() for line in told[1].splitlines()]
            assert complaints.removeprefix("simrender: ").splitlines() == expected
        else:
            assert status.value.code == 0, complaints
            assert printed or "wrote" in complaints, command
