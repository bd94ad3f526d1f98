"""The same batch on a dask.distributed cluster."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="extra archive is not installed")
pytest.importorskip("duckdb", reason="extra archive is not installed")
pytest.importorskip("distributed", reason="extra cluster is not installed")

from broken import broken, sound
from watching import done, wait_until

import csas_shadow_ros
from csas_shadow_ros.archive.find import Found
from csas_shadow_ros.cli import main

ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]
COARSE = ("--step-deg", "30", "--voxel-size-m", "0.04", "--no-sync", "--quiet")


class Cluster:
    """A scheduler and workers as processes of their own, each in a folder of its own."""

    def __init__(self, folder: Path, workers: int) -> None:
        self.folder, self.file = folder, folder / "scheduler.json"
        folder.mkdir()
        self.scheduler = self._start("scheduler", "--port", "0")
        end = time.monotonic() + 60
        while not self.file.exists():
            assert time.monotonic() < end, "the scheduler does not come up"
            time.sleep(0.05)
        self.workers = [self._start("worker", "--nthreads", "1", "--no-nanny") for _ in range(workers)]

    def _start(self, kind: str, *options: str) -> subprocess.Popen:
        place = self.folder / f"{kind}_{len(list(self.folder.iterdir()))}"
        place.mkdir()
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(self.file)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with (place / "log").open("w") as log:
            return subprocess.Popen(
                [*command, "--no-dashboard", *options], cwd=place, env=environment, stdout=log, stderr=log
            )

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def clusters(tmp_path):
    """What starts clusters; they end with the test."""
    made: list[Cluster] = []

    def start(workers: int = 2) -> Cluster:
        made.append(Cluster(tmp_path / f"cluster_{len(made)}", workers))
        return made[-1]

    yield start
    for one in made:
        one.end()


def batch(bags: Path, out: Path, cluster: Cluster) -> subprocess.Popen:
    command = [sys.executable, "-m", "csas_shadow_ros", "batch", str(bags), "--out", str(out)]
    command += ["--scheduler-file", str(cluster.file), *COARSE]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_a_local_cluster_takes_the_same_tasks(tiny_box_bag, tmp_path):
    from distributed import LocalCluster

    kinds = ("cut", "garbage", "no_track")
    for number, kind in enumerate(kinds):
        broken(tiny_box_bag.run, tmp_path / "bags" / kind, kind, number)
    out = tmp_path / "a"
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as made:
        address = ("--scheduler", made.scheduler_address)
        assert main(["batch", str(tmp_path / "bags"), "--out", str(out), *address, *COARSE]) == 3
    assert {row["name"]: row["status"] for row in Found(out).rows()} == dict.fromkeys(kinds, "failed")


@pytest.mark.long
def test_a_cluster_of_workers_in_other_folders_leaves_the_rows_that_this_machine_does(
    tiny_box_bag, tmp_path, clusters
):
    folder = tmp_path / "bags"
    sound(tiny_box_bag.run, folder / "sound", 0)
    broken(tiny_box_bag.run, folder / "no_track", "no_track", 1)
    out, local = tmp_path / "a", tmp_path / "b"
    cluster = clusters()
    assert (
        main(["batch", str(folder), "--out", str(out), "--scheduler-file", str(cluster.file), *COARSE]) == 3
    )
    assert main(["batch", str(folder), "--out", str(local), "--workers", "1", *COARSE]) == 3
    # Whoever did it, the rows say the same, but for when and how fast.
    own = {"finished", "seconds", "peak_memory_mb", "versions"}
    assert [{k: v for k, v in row.items() if k not in own} for row in Found(out).rows()] == [
        {k: v for k, v in row.items() if k not in own} for row in Found(local).rows()
    ]


@pytest.mark.long
def test_killed_workers_scheduler_and_batch_of_a_cluster_cost_only_what_was_in_flight(
    tiny_box_bag, tmp_path, clusters
):
    folder, out = tmp_path / "bags", tmp_path / "a"
    sounds = {sound(tiny_box_bag.run, folder / f"sound_{n}", n).name for n in range(8)}
    faults = {
        broken(tiny_box_bag.run, folder / kind, kind, n).name for n, kind in enumerate(("cut", "no_track"), 8)
    }

    cluster = clusters()
    first = batch(folder, out, cluster)
    wait_until(lambda: done(out), "a first result")
    cluster.workers[0].kill()
    wait_until(lambda: len(done(out)) >= 3, "three results, the last of one worker")
    before = done(out)
    cluster.scheduler.kill()
    said = first.communicate(timeout=120)[1]
    assert first.returncode == 1
    assert said.splitlines()[-1].startswith("csas-shadow: error: scheduler ")
    assert "is gone; finished bags are kept, the same command resumes" in said
    cluster.end()
    assert before.items() <= done(out).items()

    before, other = done(out), clusters()
    second = batch(folder, out, other)
    wait_until(lambda: len(done(out)) >= len(before) + 2, "two more results")
    second.kill()
    second.communicate()
    before = {**before, **done(out)}
    third = batch(folder, out, other)
    said = third.communicate(timeout=600)[1]
    assert third.returncode == 3, said
    after = done(out)
    assert before.items() <= after.items()
    assert len(after) == len(sounds)
    rows = {row["name"]: row["status"] for row in Found(out).rows()}
    assert rows == {**dict.fromkeys(sounds, "done"), **dict.fromkeys(faults, "failed")}
    fourth = batch(folder, out, other)
    fourth.communicate(timeout=120)
    assert fourth.returncode == 3
    assert done(out) == after


def test_a_scheduler_that_is_not_there_is_one_line(tiny_box_bag, tmp_path, capsys):
    bag = str(tiny_box_bag.path)
    assert main(["batch", bag, "--out", str(tmp_path / "a"), "--scheduler", "nonsense://1"]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("csas-shadow: error: scheduler nonsense://1 does not answer (")
