"""How the chain does on scenes drawn at random, rather than on targets that it was made with.

A scene is drawn from stated distributions (`draw`) by its half and its number alone: shape, size, pose,
seabed, track, faults, sonar. The **development** half and the **test** half share no shape family: the test
half is run once, at the end of a change, and nobody looks into it while working::

    python benchmarks/population.py --half development --scenes 40 --workers 2 --out FOLDER

``--half validation`` draws from families that neither half has: what was chosen on the development half is
tried on these before the test half is run.

Every scene goes through the whole automatic chain with default parameters, as ``csas-shadow run`` takes it;
only what a user sets by the sonar (voxel) or by the time there is (aspect step) is set. FOLDER/scenes.jsonl
takes a line as each scene is done, and a run that was interrupted goes on. The images are small, 448 to 1408
pixels: a scene takes 5 to 15 s on one core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
from accuracy import code_fingerprint
from population_page import family_table, publish, seabed_table, tables
from population_scenes import DEVELOPMENT, DRAWING, HALVES, TEST
from population_scores import Row, score_scene

Result = TypeVar("Result")

#: What of the benchmark decides its numbers.
_OWN = ("population_scenes.py", "population_scores.py")
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def code_digest() -> str:
    """Return a digest of the code that decides the numbers: its rows are not mixed with others'."""
    digest = hashlib.sha256(code_fingerprint().encode())
    for name in _OWN:
        digest.update((Path(__file__).resolve().parent / name).read_bytes())
    return digest.hexdigest()[:16]


def read_rows(path: Path, half: str, code: str | None = None) -> dict[int, Row]:
    """Read the rows of a half; the last one of a scene counts.

    Parameters
    ----------
    path : Path
        The .jsonl file; may be missing, and its last line may be cut short.
    half : str
        Which half.
    code : str, optional
        Leave out the rows that other code made.
    """
    rows: dict[int, Row] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            values = json.loads(line)
        except json.JSONDecodeError:  # the run ended while it wrote this
            continue
        same = values["half"] == half and values["drawing"] == DRAWING
        if same and (code is None or values["code"] == code):
            row = Row.from_json(values)
            rows[row.index] = row
    return rows


def _one_thread() -> None:
    cv2.setNumThreads(1)


def in_processes(
    work: Callable[..., Result], calls: Sequence[tuple[Any, ...]], workers: int
) -> Iterator[Result]:
    """Yield what a function returns for each tuple of arguments, as soon as it does.

    Parameters
    ----------
    work : callable
        A function of a module.
    calls : sequence of tuple
        Arguments of each call.
    workers : int
        Processes with one thread each; 1: this one.
    """
    if workers == 1:
        for arguments in calls:
            yield work(*arguments)
        return
    # The variables are read when the libraries are loaded: they are for the processes that start now.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread)
    try:
        for future in as_completed([pool.submit(work, *arguments) for arguments in calls]):
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def run_scenes(
    half: str, indices: Sequence[int], out: Path, *, workers: int = 1, say: Callable[[str], None] = _say
) -> list[Row]:
    """Score scenes and write each down as soon as it is done; those that the same code did are kept.

    Parameters
    ----------
    half : str
        Which half.
    indices : sequence of int
        Which scenes.
    out : Path
        Folder of scenes.jsonl and shapes/.
    workers : int
        Processes, one scene each.
    say : callable
        Takes a line of progress.

    Returns
    -------
    list of Row
        In the order of their numbers.
    """
    out.mkdir(parents=True, exist_ok=True)
    record, code = out / "scenes.jsonl", code_digest()
    rows = {i: row for i, row in read_rows(record, half, code).items() if i in set(indices)}
    todo = [i for i in indices if i not in rows]
    if rows:
        say(f"{len(rows)} of {len(indices)} scenes were done before")
    with record.open("a", encoding="utf-8") as file:
        if record.stat().st_size and not record.read_bytes().endswith(b"\n"):
            file.write("\n")  # a line that was cut short stays alone
        calls = [(half, index, out / "shapes") for index in todo]
        for row in in_processes(score_scene, calls, workers) if todo else ():
            row = replace(row, code=code)
            rows[row.index] = row
            file.write(json.dumps({**asdict(row), "drawing": DRAWING}) + "\n")
            file.flush()
            say(f"{len(rows)}/{len(indices)} {row.name} {row.family}: {_outcome(row)}, {row.seconds:.0f} s")
    return [rows[i] for i in sorted(rows)]


def _outcome(row: Row) -> str:
    if row.refused:
        return f"refused: {row.refused[:60]}"
    if not row.bodies:
        return f"{row.objects} objects"
    return ", ".join(f"IoU {b.iou_hull:.2f}" if b.found else "missed" for b in row.bodies)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--half", choices=HALVES, default=DEVELOPMENT)
    add("--scenes", type=int, default=40, help="how many, from the first on: 40")
    add("--only", type=int, nargs="+", metavar="N", help="these scenes alone")
    add("--workers", type=int, default=2, help="processes, one scene each: 2")
    add("--out", type=Path, required=True, metavar="FOLDER", help="takes scenes.jsonl, page.md and figures/")
    add(
        "--page", type=Path, metavar="FILE", help="write the page there of what FOLDER holds, and run nothing"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.workers < 1 or options.scenes < 1:
        parser.error("--workers and --scenes expect at least 1")
    record = options.out / "scenes.jsonl"
    if options.page is not None:
        rows = [row for _, row in sorted(read_rows(record, options.half).items())]
        if not rows:
            parser.error(f"{record} holds no scene of the {options.half} half")
        publish(rows, options.half, options.out, options.page)
        return 0
    indices = options.only or list(range(options.scenes))
    if options.half == TEST:
        _say("the test half: for the end of a change. What it shows is no guide to the next one")
    rows = run_scenes(options.half, indices, options.out, workers=options.workers)
    publish(rows, options.half, options.out, options.out / "page.md")
    print("\n".join([*tables(rows), "", *family_table(rows), "", *seabed_table(rows)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
