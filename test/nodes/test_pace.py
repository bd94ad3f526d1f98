"""When a growing result is published, and when it is said to be the end result."""

from __future__ import annotations

import pytest

from csas_shadow_ros.nodes.runtime import pace
from csas_shadow_ros.nodes.runtime.pace import IDLE_S, SOURCE_GONE_S, SOURCE_SILENT_S, Growing


class Made:
    """A growing result on a clock of its own; what was published, and whether as the end result."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        *,
        looked_at: bool = False,
        hz: float = 0.0,
        source: bool = False,
    ) -> None:
        self.now = 1000.0
        monkeypatch.setattr(pace.time, "monotonic", lambda: self.now)
        self.told: list[tuple[float, bool]] = []
        self.growing = Growing(self._publish, lambda: looked_at, hz, lambda: source)

    def _publish(self) -> None:
        self.told.append((round(self.now - 1000.0, 1), self.growing.final))

    def wait(self, seconds: float, *, ended: bool | None = None) -> None:
        """Let time pass; with `ended` a source speaks all along."""
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            if ended is not None:
                self.growing.source_says(ended)
            self.growing.tick(self.now)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    return Made(monkeypatch)


def test_a_source_that_was_killed_ends_no_run(made):
    made.growing.source_says(False)
    made.growing.changed()
    made.wait(20.0)  # its successor loads libraries on a busy machine
    assert [final for _, final in made.told] == [False], "shown as it is, and as no end"
    made.growing.changed()
    made.wait(2.0, ended=False)
    made.wait(0.1, ended=True)
    assert made.told[-1][1]
    assert made.growing.complete


def test_a_source_that_never_comes_back_ends_the_run_after_a_bounded_time(made):
    made.growing.source_says(False)
    made.growing.changed()
    made.wait(SOURCE_GONE_S + 5.0)
    shown, end = made.told
    assert shown == (pytest.approx(SOURCE_SILENT_S, abs=0.3), False)
    assert end == (pytest.approx(SOURCE_GONE_S, abs=0.3), True)
    made.wait(100.0)
    assert len(made.told) == 2, "said once"
    made.growing.changed()
    assert not made.growing.final, "a view that comes after all opens it again"
    made.wait(0.1, ended=True)
    assert made.told[-1][1]


def test_without_any_source_a_result_that_rests_is_the_end_result(made):
    made.growing.changed()
    made.wait(IDLE_S + 0.5)
    assert made.told == [(pytest.approx(IDLE_S, abs=0.3), True)]
    assert not made.growing.complete, "nobody has said so"


def test_who_has_not_heard_the_source_yet_ends_no_run(monkeypatch):
    """A killed sink's successor on a busy machine gets its first views before the source's first word."""
    made = Made(monkeypatch, source=True)
    made.growing.changed()
    made.wait(SOURCE_GONE_S - 1.0)
    assert [final for _, final in made.told] == [False], "shown as it is, and as no end"
    made.wait(2.0)
    assert made.told[-1] == (pytest.approx(SOURCE_GONE_S, abs=0.3), True), "it never said a word"


def test_a_source_that_is_silent_is_told(made):
    made.growing.source_says(False)
    assert made.growing.silent_s == 0.0
    made.growing.changed()
    made.wait(SOURCE_SILENT_S + 1.0)
    assert made.growing.silent_s == pytest.approx(SOURCE_SILENT_S + 1.0)
    made.growing.source_says(False)
    assert made.growing.silent_s == 0.0


def test_unfinished_results_are_published_at_their_rate_to_those_who_look(monkeypatch):
    made = Made(monkeypatch, looked_at=True, hz=1.0)
    for _ in range(50):
        made.growing.changed()
        made.wait(0.1, ended=False)
    assert len(made.told) == pytest.approx(5, abs=1)
    assert not any(final for _, final in made.told)
