"""Imports inside the package: no circles, only in the order of its layers, and nothing heavy before it is needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "edge_se_sampler"
ROOT = Path(__file__).parent.parent / PACKAGE
LAYERS = [
    ("errors", "protocol", "devices", "ranks", "interrupts"),
    ("sampling",),
    ("",),  # the package itself: the public API
    ("data",),
    ("occupancy",),
    ("models",),
    ("engine",),
    ("methods",),
    ("nerfstudio", "bench", "export", "viewer", "masks"),
    ("commands", "run_commands"),
    ("cli",),
    ("__main__",),
]
"""Files and folders of the package. Each may import from its own layer and from earlier ones."""
HEAVY = {"torch", "numba", "cv2", "matplotlib", "tyro", "imageio", "nerfstudio", "viser"}


def module_name(path: Path, root: Path) -> str:
    """Dotted name within the package; the package itself is ""."""
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix("__init__").removesuffix(".")


def imports(root: Path) -> dict[str, set[str]]:
    """Module -> modules of the package that it imports anywhere: at its top, for types only, or within functions."""
    paths = {module_name(path, root): path for path in sorted(root.rglob("*.py"))}
    return {name: set(_imported(path, paths)) - {name} for name, path in paths.items()}


def _imported(path: Path, modules: dict[str, Path]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: a relative import"
            # from a.b import c: c is a module, or a name in the module a.b
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if _inside(name) in modules else node.module for name in names]
        else:
            continue
        yield from (_inside(name) for name in names if name and name.split(".")[0] == PACKAGE)


def _inside(name: str | None) -> str:
    return (name or "").removeprefix(PACKAGE).removeprefix(".")


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; none: empty."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def upward(graph: dict[str, set[str]]) -> list[str]:
    """Imports from a later layer."""
    layer = {name: number for number, names in enumerate(LAYERS) for name in names}
    return [
        f"{module} imports {imported}"
        for module, names in graph.items()
        for imported in sorted(names)
        if layer[module.split(".")[0]] < layer[imported.split(".")[0]]
    ]


def test_no_module_imports_itself_through_others() -> None:
    assert circle(imports(ROOT)) == []


def test_imports_follow_the_order_of_the_layers() -> None:
    assert upward(imports(ROOT)) == []


@pytest.mark.parametrize(
    "statement",
    [
        f"from {PACKAGE}.engine import trainer",
        f"import {PACKAGE}.engine.trainer",
        f"from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from {PACKAGE}.engine.trainer import Trainer",
        f"def late():\n    from {PACKAGE}.engine.trainer import Trainer",
    ],
)
def test_a_forbidden_import_is_found_wherever_it_stands(statement: str, tmp_path: Path) -> None:
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "trainer.py").write_text(f"import {PACKAGE}.protocol\nclass Trainer: ...\n")
    (tmp_path / "protocol.py").write_text(statement)
    assert set(circle(imports(tmp_path))) == {"protocol", "engine.trainer"}
    assert upward(imports(tmp_path)) == ["protocol imports engine.trainer"]
    (tmp_path / "protocol.py").write_text("import engine.trainer, torch\n")  # other packages are of no concern
    assert circle(imports(tmp_path)) == upward(imports(tmp_path)) == []


def modules_loaded_by(code: str) -> set[str]:
    """Modules that a new process has loaded after running some code."""
    command = [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"]
    return set(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("errors", set()),
        ("protocol", set()),
        ("sampling.random_streams", set()),
        ("sampling.registry", set()),
        ("sampling.settings", set()),
        ("methods", {"tyro"}),
        ("sampling.edges", {"cv2"}),
        ("sampling.distribution", {"torch"}),
        ("sampling.pixel_sampler", {"torch", "cv2"}),  # and all else in sampling
    ],
)
def test_importing_a_module_loads_only_what_it_needs(module: str, allowed: set[str]) -> None:
    loaded = modules_loaded_by(f"import {PACKAGE}.{module}")
    assert f"{PACKAGE}.{module}" in loaded
    assert loaded & HEAVY == allowed


def test_sampling_loads_no_files_networks_or_hosts() -> None:
    modules = [f"{PACKAGE}.sampling.{path.stem}" for path in (ROOT / "sampling").glob("[!_]*.py")]
    loaded = modules_loaded_by(f"import {', '.join(modules)}")
    assert loaded >= set(modules)
    layers = {name.split(".")[1] for name in loaded if name.startswith(f"{PACKAGE}.")}
    assert layers == {"errors", "protocol", "sampling"}


WITHOUT_UNIX = """
import asyncio, multiprocessing, os, signal, sys
sys.modules.update(dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios")))
for name in ("fork", "getuid", "killpg", "sched_getaffinity", "sysconf"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "pthread_kill", "pthread_sigmask"):
    delattr(signal, name)
from edge_se_sampler.cli import main
for command in sys.argv[1:]:
    try:
        main(command.split())
    except SystemExit as end:
        assert not end.code, command
"""


def run_without_unix(*commands: str) -> None:
    ended = subprocess.run([sys.executable, "-c", WITHOUT_UNIX, *commands], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_the_command_line_starts_without_what_windows_lacks() -> None:
    run_without_unix("methods", "bench chart --help")


@pytest.mark.slow
def test_commands_run_without_what_windows_lacks(scene: Path, run: Path, tmp_path: Path) -> None:
    run_without_unix(
        f"inspect --data {scene} --output-path {tmp_path}/inspect.png",
        f"train lean-nerf --data {scene} --output-dir {tmp_path}/o --max-num-iterations 6 --machine.device-type cpu",
        f"eval {run} --output-path {tmp_path}/eval.json",
        f"render {run} --num-frames 2 --output-path {tmp_path}/turn.gif",
        f"resume {run} --max-num-iterations 9",
        f"scenes --out {tmp_path}/scenes --names mic --size 16 --num-train 2 --num-val 1 --num-test 1",
    )
