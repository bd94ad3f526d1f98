"""A results folder: whole at every moment, what failed named in it, and checked against its checksums."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

import csas_shadow_ros
from csas_shadow_ros import durable
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.shape.result import Result
from csas_shadow_ros.durable import CHECKSUMS
from csas_shadow_ros.results import Context, ResultsError, ResultsWriter, check_results, read_report
from csas_shadow_ros.results import figures as figures_module
from csas_shadow_ros.results import folder as folder_module
from csas_shadow_ros.results.bag import ResultBag
from csas_shadow_ros.results.layout import json_ready

ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]
#: No process has it: the largest number that Linux gives is 2**22.
DEAD = 99_999_999
FAST = ("--step-deg", "30", "--voxel-size-m", "0.04", "--quiet")


def write(folder: Path, mark: str = "", **options) -> dict:
    with ResultsWriter(folder, bag=False, figures=False, **options) as writer:
        return writer.finish(Result(), Context(command=[mark]))


def mark_of(folder: Path) -> str:
    return read_report(folder)["command"][0]


@pytest.fixture
def box_bag(tiny_box_bag, tmp_path):
    """A copy of the box's bag, whose truth may be spoilt."""
    bag = tmp_path / "bag"
    shutil.copytree(tiny_box_bag.path, bag)
    for kind in ("stl", "json"):
        truth = tiny_box_bag.path.with_name(f"{tiny_box_bag.path.name}.truth.{kind}")
        shutil.copy(truth, tmp_path / f"bag.truth.{kind}")
    return bag


@pytest.fixture(scope="session")
def right_grid(tiny_box_bag, tmp_path_factory):
    """The grid of the box's bag with its sound truth."""
    out = tmp_path_factory.mktemp("right") / "out"
    bag = str(tiny_box_bag.path)
    assert main(["run", bag, "--no-bag", "--no-figures", *FAST, "--out", str(out)]) == 0
    assert read_report(out)["failed"] == {}
    return grid_of(out)


def grid_of(folder: Path) -> np.ndarray:
    with np.load(folder / "grid.npz") as file:
        return file["likelihood"]


# -- what follows the carving costs nothing but itself ---------------------------------------------------


def open_truth(stl: Path) -> None:
    mesh = trimesh.load(stl, force="mesh")
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(stl)


def truth_in_millimetres(stl: Path) -> None:
    mesh = trimesh.load(stl, force="mesh")
    mesh.apply_scale(1000.0)
    mesh.export(stl)


@pytest.mark.parametrize(
    ("spoil", "part", "told"),
    [
        (open_truth, "scores", "bag.truth.stl is not closed: it ends at 4 edges"),
        (truth_in_millimetres, "scores", "expected a mesh in metres (in mm it would be 0."),
        (lambda stl: stl.write_bytes(b"no mesh"), "truth", "bag.truth.stl cannot be read"),
    ],
)
def test_a_truth_of_no_use_costs_the_score_alone_and_is_named_three_times(
    box_bag, right_grid, tmp_path, capsys, spoil, part, told
):
    stl = tmp_path / "bag.truth.stl"
    arguments = ["run", str(box_bag), "--no-bag", "--no-figures", *FAST, "--out"]
    spoil(stl)
    capsys.readouterr()
    assert main([*arguments, str(tmp_path / "out")]) == 3
    said = capsys.readouterr()
    report = read_report(tmp_path / "out")
    assert told in report["failed"][part]
    assert told in said.err
    assert told in (tmp_path / "out" / "summary.txt").read_text()
    assert np.array_equal(grid_of(tmp_path / "out"), right_grid, equal_nan=True)
    assert (report["truth"] or {}).get("scores") is None
    assert check_results(tmp_path / "out").ok


def test_whatever_part_fails_the_grid_and_the_other_parts_are_there(box_bag, tmp_path, monkeypatch, capsys):
    whole = folder_module._write_mesh
    views = 0

    def write_mesh(path, mesh):
        whole(path, mesh)
        if path.suffix == ".glb":
            raise OSError(errno.ENOSPC, "No space left on device")

    def write_view(self, view, stream):
        nonlocal views
        views += 1
        if views > 5:
            raise OSError(errno.ENOSPC, "No space left on device")

    def draw(subject):
        raise ZeroDivisionError("no scale")

    def scored(*_):
        raise MemoryError

    monkeypatch.setattr(folder_module, "_write_mesh", write_mesh)
    monkeypatch.setattr(folder_module, "score", scored)
    monkeypatch.setattr(ResultBag, "write_view", write_view)
    monkeypatch.setitem(figures_module.FIGURES, "figure_1b_multilook", draw)
    monkeypatch.setattr("csas_shadow_ros.run_bag.describe_run", lambda run: {}["gone"])
    out = tmp_path / "out"
    assert main(["run", str(box_bag), "--out", str(out), *FAST]) == 3
    report = read_report(out)
    assert report["failed"] == {
        "input": "cannot be described: KeyError: 'gone'",
        "mesh.glb": "[Errno 28] No space left on device",
        "result.mcap": "[Errno 28] No space left on device",
        "figures/figure_1b_multilook.png": "ZeroDivisionError: no scale",
        "scores": "MemoryError: ",
    }
    names = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert {"grid.npz", "mesh.stl", "mesh.ply", "mesh.obj", "figures/figure_8_surfaces.png"} <= names
    assert not {"mesh.glb", "result.mcap", "figures/figure_1b_multilook.png"} & names
    assert set(report["files"]) == names
    checked = check_results(out)
    assert checked.ok
    assert len(checked.findings) == 5
    assert capsys.readouterr().err.count("csas-shadow: error: ") == 5


def test_a_report_takes_whatever_metadata_a_bag_has():
    import datetime

    made = json_ready({"date": datetime.date(2026, 1, 2), "raw": b"x", "nan": float("nan"), "n": 3})
    assert json.loads(json.dumps(made)) == {"date": "2026-01-02", "raw": "b'x'", "nan": None, "n": 3}


def test_an_interrupt_while_figures_are_drawn_leaves_the_grid_in_place(box_bag, tmp_path, monkeypatch):
    def draw(subject):
        raise KeyboardInterrupt

    monkeypatch.setitem(figures_module.FIGURES, "figure_1b_multilook", draw)
    assert main(["run", str(box_bag), "--out", str(tmp_path / "out"), *FAST]) == 1
    assert check_results(tmp_path / "out").ok
    report = read_report(tmp_path / "out")
    assert set(report["failed"]) == {"figures", "scores"}
    assert report["verdict"] == "object"
    assert not list(tmp_path.glob(".out*"))


# -- killed and left behind ------------------------------------------------------------------------------


def test_what_a_killed_run_left_is_removed_and_told_and_what_a_live_one_makes_is_not(tmp_path):
    left, live = tmp_path / f".r.incomplete-{DEAD}", tmp_path / f".r.incomplete-{os.getppid()}"
    others = [
        tmp_path / f".rr.incomplete-{DEAD}",
        tmp_path / ".r.incomplete-notes",
        tmp_path / "r.incomplete-1",
    ]
    for folder in (left, live, *others):
        folder.mkdir()
        (folder / "grid.npz").write_bytes(b"half")
    told = []
    write(tmp_path / "r", notice=told.append)
    assert told == [f"removed {left}, which a killed run left"]
    assert not left.exists()
    assert all(folder.exists() for folder in (live, *others))


def test_what_another_container_makes_is_kept_by_its_lock(tmp_path):
    # Its process is not to be seen here.
    place = durable.Place(tmp_path / "r")
    place.work = tmp_path / f".r.incomplete-{DEAD}"
    place.make()
    told = []
    write(tmp_path / "r", notice=told.append)
    assert (told, place.work.exists()) == ([], True)
    place.release()
    write(tmp_path / "r", notice=told.append, overwrite=True)
    assert not place.work.exists()


def test_a_result_that_was_being_replaced_is_brought_back(tmp_path):
    write(tmp_path / "r", "old")
    (tmp_path / "r").rename(tmp_path / f".r.replaced-{DEAD}")
    told = []
    with pytest.raises(ResultsError, match="exists already"):
        write(tmp_path / "r", notice=told.append)
    assert told == [f"brought {tmp_path / 'r'} back: a run was killed while it replaced it"]
    assert mark_of(tmp_path / "r") == "old"
    assert check_results(tmp_path / "r").ok


@pytest.mark.parametrize("atomic", [True, False])
def test_a_result_is_replaced_by_a_whole_one_with_and_without_an_exchange(tmp_path, monkeypatch, atomic):
    if not atomic:
        monkeypatch.setattr(durable, "exchange", lambda one, other: False)
    write(tmp_path / "r", "old")
    write(tmp_path / "r", "new", overwrite=True)
    assert mark_of(tmp_path / "r") == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def test_a_place_that_is_taken_meanwhile_is_not_replaced(tmp_path):
    with ResultsWriter(tmp_path / "r", bag=False, figures=False) as writer:
        write(tmp_path / "r", "another run")
        with pytest.raises(ResultsError, match="exists already"):
            writer.finish(Result(), Context(command=["late"]))
    assert mark_of(tmp_path / "r") == "another run"


#: Loads what is needed once, then writes in a child that the test kills.
WRITER = """
import os, sys
from csas_shadow_ros import durable
from csas_shadow_ros.core.shape.result import Result
from csas_shadow_ros.results import Context, ResultsWriter

folder = sys.argv[1]
if sys.argv[2] == "two renames":
    durable.exchange = lambda one, other: False

def write(mark):
    with ResultsWriter(folder, overwrite=True, bag=False, figures=False) as writer:
        writer.finish(Result(), Context(command=[mark]))

write("0")
print("ready", flush=True)
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        number = int(line)
        print(os.getpid(), flush=True)
        while True:
            number += 1
            write(str(number))
    os.waitpid(child, 0)
    print("dead", flush=True)
"""


@pytest.mark.parametrize("way", ["exchange", "two renames"])
def test_a_kill_at_any_moment_of_a_write_leaves_a_whole_result(tmp_path, way):
    folder, draw = tmp_path / "r", random.Random(17)
    server = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), way],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdin is not None
    assert server.stdout is not None
    newest, away = 0, 0
    try:
        assert server.stdout.readline() == "ready\n"
        for _ in range(25):
            server.stdin.write(f"{newest}\n")
            server.stdin.flush()
            child = int(server.stdout.readline())
            time.sleep(draw.uniform(0.0, 0.2))
            os.kill(child, signal.SIGKILL)
            assert server.stdout.readline() == "dead\n"
            if way == "two renames" and not folder.exists():
                away += 1
            else:
                assert check_results(folder).ok, str(check_results(folder))
            # The next start brings back what was being replaced, and clears the rest away.
            durable.Place(folder).clear(lambda _: None)
            assert check_results(folder).ok, str(check_results(folder))
            assert [p.name for p in tmp_path.iterdir()] == ["r"]
            found = int(mark_of(folder))
            assert found >= newest
            newest = found
    finally:
        server.stdin.close()
        server.wait(timeout=30)
        server.stdout.close()
    assert newest > 0
    assert away == 0 or way == "two renames"


# -- written out to the disk -----------------------------------------------------------------------------


@pytest.mark.parametrize("sync", [True, False])
def test_every_file_and_folder_is_written_out_before_it_is_in_place_unless_told_otherwise(
    tmp_path, monkeypatch, sync
):
    synced, fsync = set(), os.fsync

    def noted(number):
        found = os.fstat(number)
        synced.add((found.st_dev, found.st_ino))
        fsync(number)

    monkeypatch.setattr(os, "fsync", noted)
    write(tmp_path / "r", durable=sync)
    there = [*(tmp_path / "r").rglob("*"), tmp_path / "r", tmp_path]
    assert {(p.stat().st_dev, p.stat().st_ino) in synced for p in there} == {sync}


# -- check -----------------------------------------------------------------------------------------------


def spoil_report(folder: Path) -> None:
    (folder / "report.json").write_text('{"format": "csas_sh')


def of_another_version(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    report["format"] = "csas_shadow_ros results 9"
    (folder / "report.json").write_text(json.dumps(report))


def flip_a_bit(folder: Path) -> None:
    data = bytearray((folder / "grid.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "grid.npz").write_bytes(data)


def pipe_for_grid(folder: Path) -> None:
    (folder / "grid.npz").unlink()
    os.mkfifo(folder / "grid.npz")


def link_for_grid(folder: Path) -> None:
    shutil.copy(folder / "grid.npz", folder.parent / "elsewhere")
    (folder / "grid.npz").unlink()
    (folder / "grid.npz").symlink_to(folder.parent / "elsewhere")


SPOILT = [
    (lambda f: (f / "grid.npz").unlink(), "error: grid.npz: is missing"),
    (flip_a_bit, "error: grid.npz: has changed: its SHA-256 is another"),
    (lambda f: (f / "notes.txt").write_text("mine"), "error: notes.txt: is not listed"),
    (spoil_report, "error: report.json: cannot be read"),
    (lambda f: (f / "report.json").write_text("[" * 100_000), "error: report.json: cannot be read"),
    (lambda f: (f / "report.json").unlink(), "error: report.json: is missing"),
    (of_another_version, "its format is 'csas_shadow_ros results 9'; expected 'csas_shadow_ros results 1'"),
    (lambda f: (f / CHECKSUMS).unlink(), "without it the files cannot be checked"),
    (lambda f: (f / CHECKSUMS).write_text("0" * 64 + "  ../../etc/passwd\n"), "line 1 is "),
    (lambda f: (f / CHECKSUMS).write_bytes(b"\xff" * 99), "SHA256SUMS: cannot be read"),
    (pipe_for_grid, "error: grid.npz: is a pipe or a device; expected a plain file"),
    (link_for_grid, "error: grid.npz: is a link; expected a plain file"),
]


@pytest.mark.parametrize(("spoil", "told"), SPOILT)
def test_check_names_what_is_wrong_with_a_results_folder(tmp_path, capsys, spoil, told):
    folder = tmp_path / "r"
    write(folder)
    assert main(["check", str(folder)]) == 0
    assert f"{folder}: whole\n  3 files as written by csas-shadow" in capsys.readouterr().out
    spoil(folder)
    assert main(["check", str(folder)]) == 1
    assert told in capsys.readouterr().out
    assert main(["check", str(folder), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["ok"] is False


def test_other_programs_verify_the_checksums(tmp_path):
    write(tmp_path / "r")
    tool = shutil.which("sha256sum")
    if tool is None:
        pytest.skip("no sha256sum")
    done = subprocess.run(
        [tool, "-c", CHECKSUMS], cwd=tmp_path / "r", capture_output=True, text=True, check=True
    )
    assert done.stdout.count(": OK\n") == 3


def test_check_of_a_bag_is_as_before(tiny_box_bag, capsys):
    assert main(["check", str(tiny_box_bag.path)]) == 0
    assert "/csas/image: 1" in capsys.readouterr().out
