"""docs/reliability.md names, for each fault, tests that there are."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_each_test_that_the_page_names_is_there() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text().split("## Faults that were reported", 1)[1]
    rows = [line for line in page.splitlines() if line.startswith("| ")][1:]
    assert len(rows) == 20
    for row in rows:
        file, found = "", 0
        for word in re.findall(r"`([^`]+)`", row.split("|")[2]):
            if word.endswith(".py"):
                file = (ROOT / "test" / word).read_text()
                found += 1
                continue
            # A long name is cut at an ellipsis, at either end.
            name = re.escape(word.strip("…"))
            begin = r"\w*" if word.startswith("…") else "test_"
            end = r"\w*" if word.endswith("…") else r"\("
            assert re.search(rf"^def {begin}{name}{end}", file, re.MULTILINE), f"{word} is not there"
        assert found, row
