"""What lies where in a results folder, and how its report is read.

Apart from what writes one: readers need no chain and no kernels, which take a second to import.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import CsasError
from ..durable import CHECKSUMS

FORMAT = "csas_shadow_ros results 1"
REPORT = "report.json"
SUMMARY = "summary.txt"
GRID = "grid.npz"


class ResultsError(CsasError):
    """A results folder cannot be written or read."""


def looks_like_results(path: str | Path) -> bool:
    """Say whether a path is a results folder, if only a damaged one, rather than a bag."""
    folder = Path(path)
    if not folder.is_dir() or (folder / "metadata.yaml").exists():
        return False
    return any((folder / name).exists() for name in (REPORT, CHECKSUMS, GRID))


def is_results_folder(folder: str | Path) -> bool:
    """Say whether a folder holds results."""
    try:
        return bool(json.loads((Path(folder) / REPORT).read_text(encoding="utf-8")).get("format") == FORMAT)
    except (OSError, ValueError, AttributeError):
        return False


def read_report(folder: str | Path) -> dict[str, Any]:
    """Read the report of a results folder.

    Raises
    ------
    ResultsError
        If it is none.
    """
    if not is_results_folder(folder):
        raise ResultsError(f"{folder} is not a results folder: it holds no {REPORT} of this package")
    report: dict[str, Any] = json.loads((Path(folder) / REPORT).read_text(encoding="utf-8"))
    return report


def json_ready(value: Any) -> Any:
    """Return a value as JSON has it: NaN and infinities become null, arrays lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return json_ready(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(k): json_ready(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [json_ready(v) for v in value]
    if isinstance(value, np.ndarray):
        return json_ready(value.tolist())
    if isinstance(value, np.generic):
        return json_ready(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | int | float):
        return value
    return str(value)  # dates, paths and what else a bag's metadata may hold
