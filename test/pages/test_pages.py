"""Every command and snippet of README and site runs, in order, as a reader would run it."""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from snippets import CHEAPER, ROOT, RUN_KINDS, SHOWN_KINDS, Block, Reader, arguments_of, blocks_of, is_ours

from csas_shadow_ros.cli import build_parser

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def runs(block: Block) -> bool:
    return block.kind in RUN_KINDS and "not run" not in block.marks


def page_cases() -> list:
    """Return a case a page that has something to run; those with long blocks once more, with these."""
    cases = []
    for page in PAGES:
        blocks = [block for block in blocks_of(page) if runs(block)]
        if any("long" not in block.marks for block in blocks):
            cases.append(pytest.param(page, False, id=page.name))
        if any("long" in block.marks for block in blocks):
            cases.append(pytest.param(page, True, id=f"{page.name}, long", marks=pytest.mark.long))
    return cases


@pytest.mark.parametrize(("page", "long"), page_cases())
def test_what_a_page_shows_runs(page: Path, long: bool, tiny_box_bag, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    bag = tiny_box_bag.path
    # The reader's own run, and the demonstration's place: a small bag with its truth beside it.
    for name in ("my_run", "bags/demo"):
        shutil.copytree(bag, tmp_path / name)
        for truth in bag.parent.glob(f"{bag.name}.truth.*"):
            shutil.copy(truth, tmp_path / f"{name}{truth.name.removeprefix(bag.name)}")
    for name in ("config", "examples", "launch"):
        (tmp_path / name).symlink_to(ROOT / name)
    reader = Reader(tmp_path)
    for block in blocks_of(page):
        if runs(block) and (long or "long" not in block.marks):
            reader.do(block)


def test_every_fence_says_what_it_is() -> None:
    kinds = {block.kind for block in BLOCKS}
    assert kinds <= {*RUN_KINDS, *SHOWN_KINDS}


def test_what_is_not_run_says_why() -> None:
    without = [f"{b.page}:{b.line}" for b in BLOCKS if "not run" in b.marks and len(b.marks["not run"]) < 10]
    assert not without


NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs(notebook: Path, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            runpy.run_path(str(notebook), run_name="__notebook__")
    finally:
        plt.close("all")


def options_of_blocks_not_run() -> list:
    return [
        pytest.param(arguments_of(command), id=f"{block.page}:{block.line} {command[:40]}")
        for block in BLOCKS
        if block.kind in RUN_KINDS and not runs(block)
        for command in block.commands
        if is_ours(command)
    ]


@pytest.mark.parametrize("arguments", options_of_blocks_not_run())
def test_a_command_that_is_not_run_is_at_least_one(arguments: list[str]) -> None:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            build_parser().parse_args(arguments)
    except SystemExit as stop:
        pytest.fail(f"{arguments}: {stop.code} {said.getvalue()}")


def test_every_target_of_make_that_a_page_names_is_there() -> None:
    there = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    pattern = re.compile(r"(?:`|^)make ([a-z][a-z-]*)", re.MULTILINE)
    named = {target for page in PAGES for target in pattern.findall(page.read_text(encoding="utf-8"))}
    assert named
    assert named <= there


def test_what_makes_a_test_cheaper_are_options_that_there_are() -> None:
    for command, options in CHEAPER.items():
        given = [command, "bag", "--out", "x", *(word for option in options for word in option)]
        assert build_parser().parse_args(given) is not None
