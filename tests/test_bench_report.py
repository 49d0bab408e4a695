"""Every committed README.md is what its results say now, and `edge-se bench report` writes it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench.chart.report import tables
from edge_se_sampler.bench.real import report as real
from edge_se_sampler.bench.report import fill_template, report_of

CONFIGS = Path(__file__).parent.parent / "configs"
FOLDERS = sorted(path.parent for path in CONFIGS.rglob("README.md") if path.parent.name not in {"demo", "soak"})
"""The demo prints and draws its result; its page is written by hand. The soak is a test, which writes its page."""


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(CONFIGS)))
def test_a_committed_readme_is_generated_from_its_results(folder: Path) -> None:
    assert (folder / "README.md").read_text() == report_of(folder).describe(folder)


def test_the_tables_of_the_main_readme_are_generated() -> None:
    readme = (CONFIGS.parent / "README.md").read_text()
    for name, table in (tables(CONFIGS / "chart") | real.tables(CONFIGS / "real")).items():
        assert f"<!-- table: {name} -->\n{table}\n<!-- end -->" in readme


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a committed result."""
    folder = tmp_path / "lean-ten-seeds"
    folder.mkdir()
    for name in ("result.json", "notes.md"):
        shutil.copy(CONFIGS / folder.name / name, folder)
    return folder


def test_the_command_writes_the_readme_the_pictures_and_tables_of_another_text(
    folder: Path, tmp_path: Path, edge_se: Any
) -> None:
    text = tmp_path / "text.md"
    text.write_text("before\n<!-- table: methods -->\nold\n<!-- end -->\nafter\n")
    answer = edge_se("bench", "report", folder, "--readme", text)
    assert answer.code == 0, answer
    assert (folder / "README.md").read_text() == (CONFIGS / folder.name / "README.md").read_text()
    assert (folder / "scenes.png").exists()
    lines = text.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after")
    assert "old" not in lines
    assert any(line.startswith("| lean-nerf |") for line in lines)


def test_folders_without_results_and_texts_without_markers_are_refused(
    folder: Path, tmp_path: Path, edge_se: Any
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "plain.md").write_text("no markers")
    (tmp_path / "latin.md").write_bytes("für".encode("latin-1"))
    for options, message in (
        ((tmp_path / "empty",), "no result of edge-se bench lies there"),
        ((folder, "--readme", tmp_path / "none.md"), "cannot be read"),
        ((folder, "--readme", tmp_path / "plain.md"), "has no marker <!-- table: methods -->"),
        ((folder, "--readme", tmp_path / "latin.md"), "is not UTF-8 text (byte 1)"),
    ):
        answer = edge_se("bench", "report", *options)
        assert answer.code == 2, answer
        assert message in answer.err


def test_results_of_others_in_a_subfolder_change_nothing(folder: Path) -> None:
    expected = report_of(folder)
    (folder / "earlier").mkdir()
    shutil.copy(CONFIGS / "processes" / "result.json", folder / "earlier")
    assert report_of(folder) is expected


def test_a_template_is_filled_without_the_sections_and_pictures_that_are_missing(tmp_path: Path) -> None:
    (tmp_path / "there.png").touch()
    (tmp_path / "report.md").write_text(
        "# Title\n\n{note}\n\n![a](there.png)\n*caption*\n\n![b](missing.png)\n*caption*\n\n"
        "## Nothing to say\n\n{empty} of {absent:.1f}.\n\n## Sizes\n\n{size:.1f} m\n\n## Plain\n\nText.\n"
    )
    filled = fill_template(str(tmp_path / "report.py"), tmp_path, note="", size=2)
    assert filled == "# Title\n\n![a](there.png)\n*caption*\n\n## Sizes\n\n2.0 m\n\n## Plain\n\nText.\n"
    with pytest.raises(KeyError, match="absent"):  # a section with some of its values is a mistake
        fill_template(str(tmp_path / "report.py"), tmp_path, note="", empty="x", size=2)
