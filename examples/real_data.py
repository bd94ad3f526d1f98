"""Where the examples find measured data, which are not part of the package."""

from __future__ import annotations

import os
from pathlib import Path

from csas_shadow_ros.core.errors import CsasError


def data_file(name: str, argument: str | None = None) -> Path:
    """Find a data file: as given, or in the folder CSAS_REAL_DATA, or in ``../shared/real``.

    Raises
    ------
    CsasError
        If it is not there; the message says where it was looked for.
    """
    if argument:
        candidates = [Path(argument)]
    else:
        root = Path(__file__).resolve().parents[1]
        folders = [Path(os.environ["CSAS_REAL_DATA"])] if "CSAS_REAL_DATA" in os.environ else []
        candidates = [folder / name for folder in (*folders, root.parent / "shared" / "real")]
    for path in candidates:
        path = path / name if path.is_dir() else path
        if path.is_file():
            return path
    looked = ", ".join(str(c) for c in candidates)
    raise CsasError(
        f"{name} is not at {looked}; expected its path as argument, or its folder in CSAS_REAL_DATA"
        " (measured data are not part of the package)"
    )
