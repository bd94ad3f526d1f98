"""Cold and warm starts: what the first run on a machine waits for, side by side.

`python benchmarks/start.py` compiles everything in a folder of its own, and uses nothing
that the machine compiled before.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "demo"


def seconds(cache: Path, *arguments: object) -> float:
    """Return how long `csas-shadow` takes with kernels kept in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "csas_shadow_ros.cli", *map(str, arguments)]
    began = time.perf_counter()
    subprocess.run(command, check=True, env=environment, cwd=ROOT, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def main() -> None:
    """Print a table: seconds, and times the warm run."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)

        def run(cache: str, number: int) -> float:
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
    reference = table["run, the second"]
    for name, value in table.items():
        print(f"{name:28s} {value:7.2f} s   {value / reference:6.2f} x")


if __name__ == "__main__":
    main()
