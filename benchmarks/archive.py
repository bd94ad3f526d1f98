"""Archives: wall time against one processor's, growth with the number of runs, a catalogue of 100 000 rows.

``python benchmarks/archive.py runs --counts 25 50 100`` processes that many tiny runs, a tenth of them
broken, on two workers; ``python benchmarks/archive.py rows --counts 1000 10000 100000`` fills catalogues with
rows of made-up runs. ``python benchmarks/archive.py course --counts 250 1000 4000`` has that many bags fail
at once, which shows what the batch itself takes. All need the extra ``archive``; figures are in
docs/archive.md.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test" / "archive")]
COARSE = ("--step-deg", "30", "--voxel-size-m", "0.04", "--quiet", "--json")
#: Runs that are processed one after another, with one thread, to know what one takes.
SERIAL = 10


def make_runs(folder: Path, count: int) -> list[Path]:
    """Write so many bags, all different, every tenth broken in a way of its own; return the sound ones."""
    from broken import FAULTS, KINDS, broken, sound

    from csas_shadow_ros.simulation import simulate

    scenes = [simulate("tiny", target, seed=seed) for seed, target in enumerate(("box", "cylinder", "cone"))]
    made = []
    for number in range(count):
        run = scenes[number % len(scenes)]
        if number % 10 == 9:
            # Of a second round only what differs from the first: bags that hold the same are one.
            kind = [*KINDS, *FAULTS][min(number // 10, len(KINDS) + number // 10 % len(FAULTS))]
            # Of the box: of the cylinder, whose shadows leave the image, no sign is called wrong.
            broken(scenes[0], folder / f"{number:04d}_{kind}", kind, number)
        else:
            made.append(sound(run, folder / f"{number:04d}", number))
    return made


def batch(folder: Path, out: Path, workers: int) -> dict:
    """Run a batch as a program of its own; return what it says."""
    command = [sys.executable, "-m", "csas_shadow_ros", "batch", str(folder), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*command, "--workers", str(workers), *COARSE],
        env=environment,
        cwd="/",
        stdout=subprocess.PIPE,
        check=False,
    )
    if done.returncode not in (0, 3):
        raise SystemExit(done.returncode)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads(done.stdout) | {"cpu_s": cpu_s}


def serial_seconds(bags: list[Path], out: Path) -> float:
    """Return the processor time of a run, after warm-up: one process, one thread."""
    from csas_shadow_ros import parameters
    from csas_shadow_ros.archive.layout import Archive
    from csas_shadow_ros.archive.task import Options, Task, process

    Archive(out).make()
    options = Options(parameters(step_deg=30.0, voxel_size_m=0.04))
    tasks = [Task(str(out), str(bag), options) for bag in bags[: SERIAL + 3]]
    for task in tasks[:3]:
        process(task)
    began = time.process_time()
    for task in tasks[3:]:
        process(task)
    return (time.process_time() - began) / len(tasks[3:])


def runs(counts: list[int]) -> None:
    """Print a line a number of runs.

    Where others use the machine too, wall time says little: processor time of the batch and all its workers,
    against that of the same runs one after another, is what two idle processors would share.
    """
    with tempfile.TemporaryDirectory() as place:
        one = 0.0
        print("| runs | wall | of serial CPU / 2 | CPU, all told | of serial CPU | batch process | archive |")
        print("|---|---|---|---|---|---|---|", flush=True)
        for count in counts:
            folder, out = Path(place) / f"bags_{count}", Path(place) / f"archive_{count}"
            sound = make_runs(folder, count)
            one = one or serial_seconds(sound, Path(place) / "serial")
            said = batch(folder, out, 2)
            assert said["failed"] == count - len(sound), said
            share = said["seconds"] / (one * len(sound) / 2)
            size = sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) / 1e6
            print(
                f"| {count} | {said['seconds']:.0f} s | {share:.2f} | {said['cpu_s']:.0f} s"
                f" | {said['cpu_s'] / (one * len(sound)):.2f} | {said['memory_mb']:.0f} MB"
                f" | {size:.0f} MB |",
                flush=True,
            )
        print(f"\nserial: {one:.2f} s of processor time a run; load {os.getloadavg()[0]:.1f}")


def course(counts: list[int]) -> None:
    """Print a line a number of bags that hold no recording: they cost their way through the batch alone."""
    print("| bags | wall | a bag | batch process |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as place:
        for count in counts:
            folder = Path(place) / f"bags_{count}"
            folder.mkdir()
            for number in range(count):
                (folder / f"{number:06d}.mcap").write_text(f"no recording, number {number}")
            said = batch(folder, Path(place) / f"archive_{count}", 2)
            assert said["failed"] == said["runs"] == count, said
            each = 1e3 * said["seconds"] / count
            print(
                f"| {count} | {said['seconds']:.0f} s | {each:.1f} ms | {said['memory_mb']:.0f} MB |",
                flush=True,
            )
    print(f"\nload {os.getloadavg()[0]:.1f}")


def made_up(number: int, rng: random.Random) -> object:
    """Return rows as long as real ones."""
    from csas_shadow_ros.archive.rows import CONTACT_COLUMNS, RUN_COLUMNS, Rows

    def value(name: str, kind: str) -> object:
        if kind == "text":
            return name
        return rng.random() if kind == "number" else rng.randrange(1000)

    shared = {"task": f"/archive/raw/2026/run_{number:06d}", "number": 1, "finished": number, "time": number}
    versions = json.dumps({f"library_{n}": "1.2.3" for n in range(25)})
    run = {n: value(n, k) for n, k in RUN_COLUMNS.items()} | shared
    run |= {"bag": shared["task"], "name": f"run_{number:06d}", "status": "done", "versions": versions}
    run |= {"content": f"{rng.getrandbits(256):064x}", "signature": f"{rng.getrandbits(128):032x}"}
    run |= {"reasons": "the shadow leaves the image in 25 of 36 views, expected a larger image"}
    contact = {n: value(n, k) for n, k in CONTACT_COLUMNS.items() if k != "truth"} | shared | {"object": 1}
    contact |= {"latitude_deg": rng.uniform(48, 49), "longitude_deg": rng.uniform(-5, -4)}
    contact |= {"east_half_m": 0.1, "north_half_m": 0.1}
    return Rows([run], [contact])


def rows_once(count: int) -> None:
    """Fill a catalogue and ask it; print a line."""
    from csas_shadow_ros.archive.catalogue import Catalogue
    from csas_shadow_ros.archive.find import Found
    from csas_shadow_ros.archive.layout import Archive

    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as place:
        archive = Archive(Path(place) / "a")
        archive.make()
        catalogue = Catalogue(archive)
        spent = 0.0
        for number in range(count):
            rows = made_up(number, rng)
            start = time.perf_counter()
            catalogue.add(rows)
            spent += time.perf_counter() - start
        start = time.perf_counter()
        catalogue.merge()
        spent += time.perf_counter() - start
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        size = sum(p.stat().st_size for p in archive.catalogue.iterdir()) / 1e6
        start = time.perf_counter()
        known = sum(1 for _ in Catalogue(archive).known())
        look = time.perf_counter() - start
        assert known == count
        start = time.perf_counter()
        Found(archive.root).near(48.5, -4.5, 1000.0).where("length_m > 0.5").rows()
        find = time.perf_counter() - start
        start = time.perf_counter()
        Found(archive.root).same().rows()
        same = time.perf_counter() - start
    print(
        f"| {count} | {size:.1f} MB | {1e3 * spent / count:.2f} ms a run | {memory:.0f} MB | {look:.2f} s"
        f" | {find:.2f} s | {same:.2f} s |",
        flush=True,
    )


def rows(counts: list[int]) -> None:
    """Print a line a number of rows, each from a process of its own."""
    print("| rows | catalogue | writing it | process | known at start | find | same |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for count in counts:
        subprocess.run([sys.executable, __file__, "rows-once", "--counts", str(count)], check=True)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("runs", "rows", "rows-once", "course"))
    parser.add_argument("--counts", type=int, nargs="+", required=True)
    arguments = parser.parse_args()
    if arguments.what == "rows-once":
        rows_once(arguments.counts[0])
    else:
        {"runs": runs, "rows": rows, "course": course}[arguments.what](arguments.counts)


if __name__ == "__main__":
    main()
