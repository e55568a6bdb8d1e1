"""What the tests share: a trace cache of their own, small meshes and cards, and the command line in-process."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from simrender.cli import main

CELLS = 12


class Ran(NamedTuple):
    """What a command line came to."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session", autouse=True)
def trace_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Keep the traces of this session in a temporary folder, never in the user's cache."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMRENDER_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def ply() -> Path:
    """A real mesh, an airplane of 2,452 triangles, that the pyvista wheel ships; pyvista itself is slow to import."""
    spec = importlib.util.find_spec("pyvista")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "examples" / "airplane.ply"


def ply_text(vertices: object, faces: object) -> str:
    """A PLY file; its header announces what is there."""
    v, f = np.asarray(vertices, dtype=float).reshape(-1, 3), np.asarray(faces, dtype=int).reshape(-1, 3)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(v)}\nproperty float x\nproperty float y\nproperty float z\n"
    header += f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x!r} {y!r} {z!r}\n" for x, y, z in v.tolist()] + [f"3 {a} {b} {c}\n" for a, b, c in f.tolist()]
    return header + "".join(rows)


def bumpy_grid() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a bumpy square of 288 triangles."""
    x, y = np.meshgrid(np.linspace(-1, 1, CELLS + 1), np.linspace(-1, 1, CELLS + 1), indexing="ij")
    vertices = np.stack([x, y, 0.2 * np.sin(4 * x) * np.cos(3 * y)], -1).reshape(-1, 3)
    i = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = (corner.ravel() for corner in (i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])


TINY_CARD = """\
title: A bumpy square
published: {resolution: 64x36, samples: 2}
traced: {resolution: 64x36}
scene: {file: bumpy.ply}
camera: {position: [2.0, -2.0, 1.5], look_at: [0, 0, 0]}
"""


@pytest.fixture
def tiny_card(tmp_path: Path) -> Path:
    """The card of a workload of 288 triangles, 64x36 pixels and 2 samples; its mesh lies beside it."""
    (tmp_path / "bumpy.ply").write_text(ply_text(*bumpy_grid()))
    card = tmp_path / "tiny.yaml"
    card.write_text(TINY_CARD)
    return card


@pytest.fixture
def mesh_file(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a PLY file from vertices and faces, the bumpy square's by default."""

    def write(name: str, vertices: object = None, faces: object = None) -> Path:
        own = bumpy_grid()
        text = ply_text(own[0] if vertices is None else vertices, own[1] if faces is None else faces)
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


@pytest.fixture
def run_cli(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    """A function that runs ``simrender ARGUMENTS`` in this process and returns its exit code, stdout and stderr."""
    monkeypatch.setenv("COLUMNS", "200")
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)

    def run(*arguments: object) -> Ran:
        capsys.readouterr()
        with warnings.catch_warnings():
            # As for a user: simrender's own warnings become notes. Anyone else's are errors, as in all tests.
            warnings.simplefilter("default", UserWarning)
            with pytest.raises(SystemExit) as stop:
                main([str(a) for a in arguments])
        return Ran(int(stop.value.code or 0), *capsys.readouterr())

    return run


@pytest.fixture
def bad(run_cli: Callable[..., Ran], tmp_path: Path) -> Callable[..., str]:
    """Run a bad command line; return its one message, after checking that it is one, on stderr alone."""
    traces = tmp_path / "traces"

    def run(*arguments: object) -> str:
        command = arguments if arguments[:1] not in {("run",), ("trace",)} else (*arguments, "--cache", traces)
        ran = run_cli(*command)
        assert ran.code == 2, ran
        assert ran.out == ""
        assert ran.err.startswith("simrender: ")
        assert ran.err.endswith("\n")
        assert "Traceback" not in ran.err
        assert "note:" not in ran.err
        assert not traces.exists(), "rays were traced before the mistake was found"
        return ran.err.removeprefix("simrender: ").removesuffix("\n")

    return run
