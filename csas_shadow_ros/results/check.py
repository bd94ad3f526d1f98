"""Whether a results folder is what was written: no file missing, changed or added."""

from __future__ import annotations

import dataclasses
import json
import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import __version__
from ..durable import BY_HAND, CHECKSUMS, sha256
from .layout import FORMAT, REPORT

#: Larger ones are not of this package: a report of 10 000 views has 5 MB.
_MOST_BYTES = 256_000_000


@dataclass(frozen=True)
class FileFinding:
    """One thing wrong with a results folder.

    Parameters
    ----------
    level : str
        ``error`` or ``warning``.
    file : str
        Its name in the folder.
    problem : str
        What is wrong.
    """

    level: str
    file: str
    problem: str

    def __str__(self) -> str:
        return f"{self.level}: {self.file}: {self.problem}"


@dataclass
class ResultsCheck:
    """What `check_results` found.

    Parameters
    ----------
    path : str
        The folder.
    files : int
        Files that are as they were written.
    version : str
        Version of the package that wrote it; empty if nobody knows.
    findings : list of FileFinding
        Errors first.
    """

    path: str
    files: int = 0
    version: str = ""
    findings: list[FileFinding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there is no error."""
        return not any(f.level == "error" for f in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dataclasses.asdict(self) | {"ok": self.ok}

    def __str__(self) -> str:
        head = f"{self.path}: {'whole' if self.ok else 'not as it was written'}"
        by = f" by csas-shadow {self.version}" if self.version else ""
        return "\n".join([head, f"  {self.files} files as written{by}", *map(str, self.findings)])


def _check_report(base: Path, check: ResultsCheck, error: Callable[..., None]) -> set[str]:
    """Look at the report itself, and at what it says that failed; return the files that it names."""
    try:
        report = json.loads(_read(base / REPORT))
    except (OSError, ValueError, RecursionError) as wrong:
        error(REPORT, f"cannot be read: {wrong}")
        return set()
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        told = report.get("format") if isinstance(report, dict) else type(report).__name__
        error(REPORT, f"its format is {told!r}; expected {FORMAT!r}, which csas-shadow {__version__} reads")
        return set()
    versions = report.get("versions")
    check.version = str(versions.get("csas_shadow_ros", "")) if isinstance(versions, dict) else ""
    failed = report.get("failed")
    for part, why in failed.items() if isinstance(failed, dict) else ():
        error(REPORT, f"the run could not make {part}: {why}", "warning")
    files = report.get("files")
    return {str(name) for name in files} if isinstance(files, list) else set()


def check_results(folder: str | Path) -> ResultsCheck:
    """Compare every file of a results folder with what was written.

    Parameters
    ----------
    folder : path-like
        A results folder.

    Returns
    -------
    ResultsCheck
        Never raises for a bad folder: that is what it is for.

    Examples
    --------
    >>> import tempfile
    >>> from csas_shadow_ros.core.shape.result import Result
    >>> from csas_shadow_ros.results import Context, ResultsWriter
    >>> with tempfile.TemporaryDirectory() as place:
    ...     with ResultsWriter(f"{place}/r", bag=False, figures=False) as writer:
    ...         _ = writer.finish(Result(), Context())
    ...     check_results(f"{place}/r").ok
    True
    """
    base = Path(folder)
    check = ResultsCheck(str(folder))

    def error(name: str, problem: str, level: str = "error") -> None:
        check.findings.append(FileFinding(level, name, problem))

    named = _check_report(base, check, error)
    try:
        listed = dict(_sums(_read(base / CHECKSUMS)))
    except (OSError, ValueError) as wrong:
        error(CHECKSUMS, f"cannot be read: {wrong}; without it the files cannot be checked")
        return _sorted(check)
    there = dict(_files(base))
    for name, sum_ in listed.items():
        kind = there.get(name)
        if kind is None:
            error(name, "is missing")
        elif kind:
            error(name, f"is {kind}; expected a plain file")
        else:
            try:
                same = sha256(base / name) == sum_
            except OSError as wrong:
                error(name, f"cannot be read: {wrong.strerror}")
                continue
            if same:
                check.files += 1
            else:
                error(name, "has changed: its SHA-256 is another")
    for name in sorted(set(there) - set(listed) - {CHECKSUMS, *BY_HAND}):
        error(name, "is not listed: it was not written with the results")
    for name in sorted(named - set(listed) - {CHECKSUMS}):
        error(name, f"is named by {REPORT}, but not listed in {CHECKSUMS}")
    return _sorted(check)


def _sorted(check: ResultsCheck) -> ResultsCheck:
    check.findings.sort(key=lambda f: (f.level != "error", f.file))
    return check


def _read(path: Path) -> str:
    if not stat.S_ISREG(os.lstat(path).st_mode):
        raise ValueError("it is not a plain file")
    if (size := path.stat().st_size) > _MOST_BYTES:
        raise ValueError(f"it has {size} bytes; expected at most {_MOST_BYTES}")
    return path.read_text(encoding="utf-8")


def _sums(text: str) -> Iterator[tuple[str, str]]:
    for number, line in enumerate(text.splitlines(), start=1):
        sum_, gap, name = line[:64], line[64:66], line[66:]
        hexadecimal = len(sum_) == 64 and not set(sum_) - set("0123456789abcdef")
        if not hexadecimal or gap != "  " or not name or name.startswith("/") or ".." in name.split("/"):
            raise ValueError(f"line {number} is {line[:80]!r}; expected a SHA-256 and a file of the folder")
        yield name, sum_


def _files(folder: Path) -> Iterator[tuple[str, str]]:
    """Give the name of each entry that is no folder, and what it is if no plain file; follow no link."""
    for place, folders, names in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        for name in [*names, *links]:
            path = Path(place, name)
            mode = path.lstat().st_mode
            kind = "" if stat.S_ISREG(mode) else "a link" if stat.S_ISLNK(mode) else "a pipe or a device"
            yield path.relative_to(folder).as_posix(), kind
