"""What the fuzzers read, in short: what they once found, and sound inputs that hypothesis changes.

The long form is guided by coverage: ``python test/faults/fuzz.py TARGET`` (Atheris).
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz import CORPUS, Target, packed, targets, unpacked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

NAMES = ("message", "mcap", "db3", "yaml")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Target, list[bytes]]]:
    return targets(tmp_path_factory.mktemp("fuzz"))


def test_messages_are_packed_into_an_input_and_out_of_it_again() -> None:
    cdrs = [b"one", b"", b"three" * 100]
    assert unpacked(packed(7, cdrs), 3) == cdrs
    assert unpacked(b"", 2) == [b"", b""]


@pytest.mark.parametrize(
    "path", sorted(CORPUS.glob("*/*")), ids=lambda path: f"{path.parent.name}-{path.name}"
)
def test_what_was_found_once_is_read_or_refused_in_one_line(
    made: dict[str, tuple[Target, list[bytes]]], path: Path
) -> None:
    made[path.parent.name][0](path.read_bytes())


@pytest.mark.parametrize("name", NAMES)
def test_a_changed_input_is_read_or_refused_in_one_line(
    made: dict[str, tuple[Target, list[bytes]]], name: str
) -> None:
    read, sound = made[name]

    @settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def changed(data: st.DataObject) -> None:
        spoilt = bytearray(data.draw(st.sampled_from(sound)))
        for _ in range(data.draw(st.integers(0, 4))):
            at = data.draw(st.integers(0, len(spoilt)))
            kept = data.draw(st.sampled_from((0, 1, 4, 8)))  # of what was there so many bytes are replaced
            spoilt[at : at + kept] = data.draw(st.binary(max_size=12))
        read(bytes(spoilt[: data.draw(st.integers(0, len(spoilt)))] if data.draw(st.booleans()) else spoilt))

    for one in sound:
        read(one)
    changed()
