"""Cold and warm starts: what the first run on a machine waits for, side by side.

`python benchmarks/start.py` compiles everything in a folder of its own, and uses nothing
that the machine compiled before.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "demo"


def seconds(cache: Path, *arguments: object) -> tuple[float, float]:
    """Return how long `csas-shadow` takes with kernels kept in a folder: on the clock, and of processors."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "csas_shadow_ros.cli", *map(str, arguments)]
    began, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, env=environment, cwd=ROOT, stdout=subprocess.DEVNULL)
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - began, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime


def main() -> None:
    """Print a table: seconds on the clock and of processors, and both in warm runs."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)

        def run(cache: str, number: int) -> tuple[float, float]:
            out = work / f"{cache}_{number}"
            return seconds(work / cache, "run", BAG, "--out", out, "--no-figures", "--no-bag", "--quiet")

        seconds(work / "warm", "--help")  # Python's own files are read from the disk once
        table = {
            "--help": seconds(work / "warm", "--help"),
            "run, nothing compiled": run("cold", 0),
            "warm, nothing compiled": seconds(work / "warm", "warm"),
            "run, the first after warm": run("warm", 0),
            "run, the second": run("warm", 1),
        }
    clock_of_warm, used_of_warm = table["run, the second"]
    for name, (clock, used) in table.items():
        ratios = f"{clock / clock_of_warm:6.2f} {used / used_of_warm:6.2f}"
        print(f"{name:26s} {clock:7.2f} s  {used:7.2f} s of processors   {ratios} x")


if __name__ == "__main__":
    main()
