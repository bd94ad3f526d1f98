"""A batch ends every bag in a row, goes on after anything, and does nothing twice."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="extra archive is not installed")
pytest.importorskip("duckdb", reason="extra archive is not installed")

from broken import KINDS, broken, sound
from watching import children_of, done, wait_until

import csas_shadow_ros
from csas_shadow_ros import parameters
from csas_shadow_ros.archive.batch import run_batch
from csas_shadow_ros.archive.catalogue import rebuild
from csas_shadow_ros.archive.find import Found
from csas_shadow_ros.archive.layout import Archive, ArchiveError
from csas_shadow_ros.archive.sources import bags_of
from csas_shadow_ros.archive.task import Options, Task, WorkerError, process
from csas_shadow_ros.archive.workers import LocalWorkers, WorkerDiedError, WorkersError
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError

ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]
COARSE = {"step_deg": 30.0, "voxel_size_m": 0.04}
COMMAND_LINE = ("--step-deg", "30", "--voxel-size-m", "0.04", "--no-sync")
#: Sound runs of the long test, with every kind of broken one.
SOUND = int(os.environ.get("CSAS_ARCHIVE_RUNS", "90"))
OPTIONS = Options(parameters(**COARSE))


class Threads:
    """Workers in threads of this process; `dies` says of which bags they die, and how often."""

    threads = 1
    window = 2

    def __init__(self, dies: dict[str, int] | None = None, on_submit=lambda task: None) -> None:
        self._pool = ThreadPoolExecutor(2)
        self.dies, self.on_submit = dies or {}, on_submit
        self.given: Counter[str] = Counter()
        self.ended: bool | None = None

    def submit(self, function, task) -> Future:
        name = Path(task.bag).name
        self.given[name] += 1
        self.on_submit(task)
        if self.given[name] <= self.dies.get(name, 0):
            future: Future = Future()
            future.set_exception(WorkerDiedError("its worker died"))
            return future
        return self._pool.submit(function, task)

    def result(self, future):
        return future.result()

    def end(self, *, now: bool) -> None:
        self.ended = now
        self._pool.shutdown(cancel_futures=now)


def rows_by_name(archive: Path) -> dict[str, dict]:
    return {row["name"]: row for row in Found(archive).rows()}


@pytest.fixture(scope="module")
def season(tiny_box_bag, tmp_path_factory):
    """A folder of three sound bags and two that are broken."""
    folder = tmp_path_factory.mktemp("season") / "bags"
    for number in range(3):
        sound(tiny_box_bag.run, folder / f"sound_{number}", number)
    broken(tiny_box_bag.run, folder / "cut", "cut", 3)
    broken(tiny_box_bag.run, folder / "no_track", "no_track", 4)
    return folder


@pytest.fixture
def failing(tiny_box_bag, tmp_path):
    """A folder of bags none of which can be processed: an archive of them takes no time."""
    folder = tmp_path / "bags"
    for number, kind in enumerate(("cut", "garbage", "emptied")):
        broken(tiny_box_bag.run, folder / kind, kind, number)
    return folder


def start(season: Path, archive: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "csas_shadow_ros", "batch", season, "--out", archive, "--workers", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [*map(str, command), *COMMAND_LINE], env=environment, cwd=season, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.long
def test_a_killed_worker_and_a_killed_batch_cost_only_what_was_in_flight(season, tmp_path):
    archive = tmp_path / "archive"
    batch = start(season, archive)
    wait_until(lambda: list(archive.glob("runs/*/*/task.json")) and children_of(batch.pid), "a first task")
    os.kill(children_of(batch.pid)[0], signal.SIGKILL)
    wait_until(lambda: done(archive), "a first result")
    workers = children_of(batch.pid)
    batch.kill()
    batch.communicate()
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), "the workers' end")
    before = done(archive)

    again = start(season, archive)
    said = again.communicate()[1]
    assert again.returncode == 3, said
    assert before.items() <= done(archive).items()
    rows = rows_by_name(archive)
    assert {name: row["status"] for name, row in rows.items()} == {
        **{f"sound_{n}": "done" for n in range(3)},
        "cut": "failed",
        "no_track": "failed",
    }
    assert {rows[f"sound_{n}"]["verdict"] for n in range(3)} == {"object"}
    assert len({rows[f"sound_{n}"]["run_ns"] for n in range(3)}) == 3
    lines = dict(line.split("\t") for line in (archive / "failed.txt").read_text().splitlines())
    assert lines == {str(season / n): rows[n]["reason"] for n in ("cut", "no_track")}
    assert "track" in rows["no_track"]["reason"]
    assert not list(archive.rglob("*.incomplete-*"))

    whole = done(archive)
    quiet = ("--quiet", "--workers", "2")
    assert main(["batch", str(season), "--out", str(archive), *quiet, *COMMAND_LINE]) == 3
    assert done(archive) == whole
    # What the folders hold is all that the catalogue knew.
    told = Found(archive).rows()
    assert rebuild(archive) == 5
    assert Found(archive).rows() == told


@pytest.mark.long
def test_a_hundred_runs_are_a_hundred_rows_whatever_is_killed(tiny_box_bag, tmp_path):
    season, out = tmp_path / "bags", tmp_path / "a"
    right = {sound(tiny_box_bag.run, season / f"run_{n}", n).name for n in range(SOUND)}
    wrong = {broken(tiny_box_bag.run, season / kind, kind, SOUND + n).name for n, kind in enumerate(KINDS)}
    # A folder without metadata is no bag: the file in it is, under its own name.
    wrong = wrong - {"no_bag"} | {"readme.mcap"}
    first = start(season, out)
    wait_until(lambda: done(out), "a first result")
    for number in (SOUND // 9, SOUND // 5):  # not the same twice: a task has one retry
        os.kill(children_of(first.pid)[0], signal.SIGKILL)
        wait_until(lambda n=number: len(done(out)) >= n, f"{number} results")
    first.kill()
    assert first.communicate()[1].count("warning: a worker died at") == 2
    before = done(out)
    second = start(season, out)
    wait_until(lambda: len(done(out)) >= len(before) + SOUND // 10, "some more")
    second.send_signal(signal.SIGINT)  # in order: what is in flight is finished
    said = second.communicate()[1]
    assert (second.returncode, said.splitlines()[-1]) == (1, "csas-shadow: error: interrupted")
    before |= done(out)
    assert len(rows_by_name(out)) >= len(before)
    third = start(season, out)
    third.communicate()
    assert third.returncode == 3
    assert before.items() <= done(out).items()
    rows = rows_by_name(out)
    assert {name for name, row in rows.items() if row["verdict"] == "object"} == right
    assert len({rows[name]["run_ns"] for name in right}) == SOUND
    assert len({rows[name]["length_m"] for name in right}) == 1
    assert {name for name, row in rows.items() if row["status"] == "failed"} == wrong
    assert len({rows[name]["reason"].replace(name, "") for name in wrong}) == len(KINDS)
    assert len((out / "failed.txt").read_text().splitlines()) == len(KINDS)


def test_a_worker_that_dies_costs_its_task_one_retry(failing, tmp_path):
    workers = Threads({"cut": 1, "garbage": 5})
    lines: list[str] = []
    summary = run_batch([failing], tmp_path / "a", lambda: workers, OPTIONS, notice=lines.append)
    assert workers.given == {"cut": 2, "garbage": 2, "emptied": 1}
    reasons = {row["name"]: row["reason"] for row in Found(tmp_path / "a").rows()}
    assert "its worker died twice" in reasons["garbage"]
    assert "died" not in reasons["cut"].rpartition("/")[2] + reasons["emptied"].rpartition("/")[2]
    assert (summary.processed, summary.failed) == (3, 3)
    assert sum("a worker died at" in line for line in lines) == 2


def test_ctrl_c_ends_with_the_bags_that_are_being_processed(failing, tmp_path):
    workers = Threads(on_submit=lambda task: os.kill(os.getpid(), signal.SIGINT))
    summary = run_batch([failing], tmp_path / "a", lambda: workers, OPTIONS)
    assert summary.interrupted
    assert workers.given.total() == len(Found(tmp_path / "a").rows()) == 1
    assert workers.ended is False
    rest = Threads()
    assert not run_batch([failing], tmp_path / "a", lambda: rest, OPTIONS).interrupted
    assert rest.given.total() == 2


def test_redo_says_what_is_done_again(failing, tmp_path, tiny_box_bag):
    out = tmp_path / "a"

    def given(redo=(), options=OPTIONS) -> set[str]:
        workers = Threads()
        run_batch([failing], out, lambda: workers, options, redo=redo)
        return set(workers.given)

    everything = {"cut", "garbage", "emptied"}
    other = Options(parameters(step_deg=45.0))
    assert given() == everything
    assert given() == set()
    assert given(options=other) == set()
    assert given(["changed"], other) == everything
    assert given(["changed"], other) == set()
    assert given(["failed"], other) == everything
    assert given(["all"], other) == everything
    (failing / "cut" / "note.mcap").write_bytes(b"more")
    assert given(options=other) == set()
    assert given(["changed"], other) == {"cut"}
    with pytest.raises(ParameterError, match="redo is 'some'; expected failed, changed, all"):
        given(["some"])


def test_a_mended_bag_takes_the_place_of_its_failure(failing, tmp_path, tiny_box_bag):
    out = tmp_path / "a"
    run_batch([failing], out, Threads, OPTIONS)
    shutil.rmtree(failing / "cut")
    sound(tiny_box_bag.run, failing / "cut", 7)
    run_batch([failing], out, Threads, OPTIONS, redo=["failed"])
    rows = rows_by_name(out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "cut": "done", "garbage": "failed", "emptied": "failed",
    }  # fmt: skip
    # The same bag elsewhere is a copy while both are there, and the run itself once it has moved.
    shutil.copytree(failing / "cut", failing / "twin")
    before = done(out)
    summary = run_batch([failing], out, Threads, OPTIONS)
    assert (summary.processed, summary.known) == (0, 4)
    assert rows_by_name(out)["twin"]["status"] == "copy"
    assert rows_by_name(out)["twin"]["object"] is None
    shutil.rmtree(failing / "cut")
    (failing / "twin").rename(failing / "moved")
    assert run_batch([failing], out, Threads, OPTIONS).processed == 0
    rows = rows_by_name(out)
    assert rows["moved"]["status"] == "done"
    assert "cut" not in rows
    assert done(out) == before
    # A task whose results somebody removed is done again.
    for place in before:
        shutil.rmtree(place)
    assert run_batch([failing], out, Threads, OPTIONS, redo=["changed"]).processed == 0
    again = process(Task(str(out), str(failing / "moved"), OPTIONS, durable=False))
    assert again.worked
    assert set(done(out)) == set(before)


def test_every_kind_of_broken_bag_is_a_row_with_a_reason_of_its_own(tiny_box_bag, tmp_path):
    folder = tmp_path / "bags"
    for number, kind in enumerate(KINDS):
        broken(tiny_box_bag.run, folder / kind, kind, number)
    summary = run_batch([*sorted(folder.iterdir()), folder / "gone"], tmp_path / "a", Threads, OPTIONS)
    assert (summary.bags, summary.failed) == (len(KINDS) + 1, len(KINDS) + 1)
    rows = rows_by_name(tmp_path / "a")
    assert {row["status"] for row in rows.values()} == {"failed"}
    reasons = {name: row["reason"].replace(name, "") for name, row in rows.items()}
    assert len(set(reasons.values())) == len(KINDS) + 1, reasons
    assert all(0 < len(reason) <= 300 and "\n" not in reason for reason in reasons.values())
    assert "Traceback" not in "".join(reasons.values())


def test_a_second_batch_of_one_archive_is_refused(failing, tmp_path):
    archive = Archive(tmp_path / "a")
    archive.make()
    with archive.held(), pytest.raises(ArchiveError, match="being written by another batch"):
        run_batch([failing], archive.root, Threads, OPTIONS)


def test_a_folder_of_other_things_is_no_archive(failing, tmp_path):
    with pytest.raises(ArchiveError, match="is not an archive; expected a new folder"):
        run_batch([failing], failing, Threads, OPTIONS)
    assert not (failing / "runs").exists()


def test_a_worker_that_is_not_fit_says_so_and_no_bag_fails_for_it(failing, tmp_path):
    Archive(tmp_path / "a").make()
    bag = str(failing / "cut")
    with pytest.raises(WorkerError, match=r"has csas_shadow_ros .*; expected 0\.0"):
        process(Task(str(tmp_path / "a"), bag, OPTIONS, version="0.0"))
    with pytest.raises(WorkerError, match=r"sees no archive at .*; expected a shared folder"):
        process(Task(str(tmp_path / "elsewhere"), bag, OPTIONS))
    assert not list((tmp_path / "a" / "runs").iterdir())


def test_a_worker_takes_no_more_memory_and_threads_than_it_may():
    workers = LocalWorkers(1, threads=1, memory_gb=0.6)
    try:
        with pytest.raises(MemoryError):
            workers.submit(bytearray, 1_000_000_000).result()
        assert len(workers.submit(bytearray, 10).result()) == 10
        assert workers.submit(os.getenv, "OPENBLAS_NUM_THREADS").result() == "1"
    finally:
        workers.end(now=True)
    with pytest.raises(ParameterError, match=r"a worker's memory is 0\.10 GB; expected 0\.5 or more"):
        LocalWorkers(1, memory_gb=0.1)
    with pytest.raises(ParameterError, match="workers is 0; expected 1 to 1024"):
        LocalWorkers(0)


def test_workers_that_do_not_start_end_the_batch_and_fail_no_bag(failing, tmp_path, monkeypatch):
    # As in a program without `if __name__ == "__main__"`: what a worker imports first ends it.
    monkeypatch.setattr("csas_shadow_ros.archive.workers._begin", os.abort)
    with pytest.raises(WorkersError, match="3 workers in a row died before they had started"):
        run_batch([failing], tmp_path / "a", lambda: LocalWorkers(1), OPTIONS)
    assert not list((tmp_path / "a").rglob("task.json"))


def test_sources_are_bags_folders_patterns_and_lists(failing, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lone = tmp_path / "bags" / "deep" / "lone.mcap"
    lone.parent.mkdir()
    shutil.copy(next((failing / "cut").glob("*.mcap")), lone)
    (tmp_path / "bags" / "deep" / "round").symlink_to(tmp_path / "bags")
    results = tmp_path / "bags" / "results"
    results.mkdir()
    (results / "report.json").write_text("{}")
    (results / "result.mcap").write_bytes(b"")
    (tmp_path / "list.txt").write_text("# of the season\nbags/cut  # twice\n\nbags/emp*\nbags/none\n")

    def named(*sources: str) -> list[str]:
        return [str(bag.relative_to(tmp_path)) for bag in bags_of(sources)]

    assert named("bags") == ["bags/cut", "bags/deep/lone.mcap", "bags/emptied", "bags/garbage"]
    assert named("bags/*a*", "bags/cut", "@list.txt") == [
        "bags/garbage",
        "bags/cut",
        "bags/emptied",
        "bags/none",
    ]
    assert "bags/garbage/garbage_0.mcap" in named("bags/**/*.mcap")
    with pytest.raises(ParameterError, match="hold no bag"):
        bags_of(["bags/x*"])
    with pytest.raises(ParameterError, match=r"list 'gone\.txt' cannot be read"):
        bags_of(["@gone.txt"])


def test_a_missing_library_is_one_line(failing, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["batch", str(failing), "--out", str(tmp_path / "a")]) == 1
    assert capsys.readouterr().err == (
        "csas-shadow: error: the catalogue needs pyarrow, which is not installed; expected: pip install"
        " 'csas_shadow_ros[archive]'\n"
    )
    assert (
        main(["batch", str(failing), "--out", str(tmp_path / "a"), "--scheduler", "x", "--workers", "2"]) == 1
    )
    assert "--workers is 2; expected none with a scheduler" in capsys.readouterr().err
