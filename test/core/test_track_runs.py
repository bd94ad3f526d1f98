"""Which run a piece of a track and a stamp belong to."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.core.errors import TrackError
from csas_shadow_ros.core.geometry import TrackBook, TrackPiece

STEP_NS = 174_000_000
START_NS = 10**15


def circle(radius=30.0, height=12.0, n=720):
    a = np.radians(np.arange(n) * 360.0 / n)
    return np.c_[radius * np.cos(a), radius * np.sin(a), np.full(n, height)]


C = circle()
STAMPS = START_NS + STEP_NS * np.arange(720)


def piece(a, b, *, positions=C, stamps=STAMPS, header_ns=None):
    return TrackPiece(stamps[a:b], positions[a:b], header_ns)


def is_the_circle(book, name=START_NS):
    track = book.track(name)
    np.testing.assert_array_equal(track.stamps_ns, STAMPS)
    np.testing.assert_array_equal(track.positions_m, C)
    return book.names == (name,)


def test_a_path_that_grows_is_one_run():
    book = TrackBook()
    assert {book.add(piece(0, n)) for n in (1, 2, 50, 720)} == {START_NS}
    assert is_the_circle(book)
    assert book.add(piece(0, 100)) == START_NS, "an older version takes nothing away"
    assert is_the_circle(book)


@pytest.mark.parametrize("keeps_header", [True, False])
def test_sliding_windows_are_one_run(keeps_header):
    book = TrackBook()
    for i in range(0, 521, 20):
        book.add(piece(i, i + 200, header_ns=START_NS if keeps_header else int(STAMPS[i + 199])))
    assert is_the_circle(book)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
@pytest.mark.parametrize("shared", [0, 1])
def test_chunks_in_any_order_are_one_run(order, shared):
    book = TrackBook()
    names = [book.add(piece(180 * k, 180 * k + 180 + shared)) for k in order]
    assert is_the_circle(book)
    # Whoever was told an earlier name finds the run by it.
    assert {book.renamed.get(name, name) for name in names} == {START_NS}
    assert all(len(book.track(name)) == 720 for name in names)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(3, 60), min_size=2, max_size=12), st.randoms(use_true_random=False))
def test_any_cut_in_any_order_gives_the_whole(lengths, random):
    ends = np.minimum(np.cumsum([0, *lengths]), 720)
    pieces = [piece(a, b) for a, b in itertools.pairwise(ends) if b > a]
    random.shuffle(pieces)
    book = TrackBook()
    for one in pieces:
        book.add(one)
    assert book.names == (START_NS,)
    np.testing.assert_array_equal(book.track(START_NS).stamps_ns, STAMPS[: ends[-1]])


def test_another_first_pose_begins_another_run():
    book = TrackBook()
    later = STAMPS + 10**12
    assert book.add(piece(0, 720)) == START_NS
    assert book.add(piece(0, 720, stamps=later)) == START_NS + 10**12
    assert book.names == (START_NS, START_NS + 10**12)


def test_another_circle_in_the_same_time_is_another_run():
    book = TrackBook()
    book.add(piece(0, 720))
    book.add(piece(0, 720, positions=circle(40.0), stamps=STAMPS + 5))
    assert book.names == (START_NS, START_NS + 5)
    assert book.track(START_NS + 5).circle[2] == pytest.approx(40.0)
    assert set(book.runs_of(int(STAMPS[300]))) == {START_NS, START_NS + 5}


def test_corrected_positions_of_the_same_track_replace_it():
    book = TrackBook()
    book.add(piece(0, 720, positions=C + 0.2))
    book.add(piece(0, 720))
    assert is_the_circle(book)
    book = TrackBook()
    book.add(piece(0, 720, positions=np.add(C, (0, 0, 3))))
    book.add(piece(0, 720))
    assert is_the_circle(book), "the name says that it is the same track, wherever it was before"


def test_a_chunk_far_away_does_not_go_on_from_another():
    book = TrackBook()
    book.add(piece(0, 360))
    assert book.add(piece(360, 720, positions=circle(45.0))) == int(STAMPS[360])


def test_a_stamp_belongs_to_the_run_that_covers_it_and_a_gap_more():
    book = TrackBook()
    book.add(piece(0, 720))
    # 3 degrees are six steps of half a degree.
    last = int(STAMPS[-1])
    for stamp, found in [
        (START_NS, START_NS),
        (last, START_NS),
        (last + 6 * STEP_NS, START_NS),
        (last + 7 * STEP_NS, None),
        (START_NS - 6 * STEP_NS, START_NS),
        (START_NS - 7 * STEP_NS, None),
        (0, None),
    ]:
        assert book.run_of(stamp) == found


def test_the_margin_does_not_grow_with_a_long_way_to_the_circle():
    far = np.linspace(np.add(C[0], (1500, -200, 8)), C[0], 4000, endpoint=False)
    poses = np.vstack([far, C])
    stamps = START_NS + STEP_NS * np.arange(len(poses))
    book = TrackBook()
    book.add(TrackPiece(stamps, poses))
    assert book.run_of(int(stamps[-1]) + 6 * STEP_NS) == START_NS
    assert book.run_of(int(stamps[-1]) + 30 * STEP_NS) is None


def test_the_oldest_run_is_forgotten():
    book = TrackBook(max_runs=3)
    names = [book.add(piece(0, 720, stamps=STAMPS + k * 10**12)) for k in range(5)]
    assert book.names == tuple(names[2:])
    with pytest.raises(TrackError, match=f"run {names[0]} is not known; known are: {names[2]}"):
        book.track(names[0])


def test_a_run_holds_a_bounded_number_of_poses_over_its_whole_time():
    book = TrackBook(max_poses=300)
    book.add(piece(0, 720))
    track = book.track(START_NS)
    assert len(track) <= 300
    assert (track.stamps_ns[0], track.stamps_ns[-1]) == (STAMPS[0], STAMPS[-1])
    assert track.gaps == ()


def test_a_track_is_the_same_object_until_it_changes():
    book = TrackBook()
    book.add(piece(0, 600))
    first = book.track(START_NS)
    assert book.track(START_NS) is first
    book.add(piece(0, 720))
    assert book.track(START_NS) is not first


def test_too_few_poses_are_a_run_but_no_track():
    book = TrackBook()
    book.add(piece(0, 2))
    assert book.run_of(START_NS) == START_NS
    with pytest.raises(TrackError, match="2 poses; expected at least 3"):
        book.track(START_NS)


@pytest.mark.parametrize(
    ("stamps", "positions", "match"),
    [
        ([], np.empty((0, 3)), "n > 0"),
        ([1, 2], C[:3], r"stamps \(2,\) and positions \(3, 3\)"),
        ([1, 3, 3], C[:3], r"pose 2 \(3 ns\) is not after pose 1 \(3 ns\)"),
    ],
)
def test_a_piece_that_is_none_is_refused(stamps, positions, match):
    with pytest.raises(TrackError, match=match):
        TrackPiece(np.array(stamps, dtype=np.int64), positions)


def test_angles_of_the_margin_are_those_of_the_gap():
    wide = TrackBook(max_gap_rad=math.radians(6.0))
    wide.add(piece(0, 720))
    assert wide.run_of(int(STAMPS[-1]) + 12 * STEP_NS) == START_NS
