"""What an archive's tests look at from outside: worker processes, and results that are in place."""

from __future__ import annotations

import time
from pathlib import Path

from csas_shadow_ros.archive.layout import Record


def children_of(pid: int) -> list[int]:
    """Return the worker processes of a batch."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes()
        except (OSError, ValueError):
            continue
        if parent == pid and b"spawn_main" in command:
            found.append(int(folder.name))
    return found


def wait_until(true, what: str, seconds: float = 600.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, f"{what}: not within {seconds:g} s"
        time.sleep(0.02)


def done(archive: Path) -> dict[str, int]:
    """Return the results folders that are in place, and their inodes: another one is another result."""
    return {
        str(path): path.stat().st_ino
        for path in archive.glob("runs/*/*/results")
        if (record := Record.read(path.parent)) is not None and not record.failed
    }
