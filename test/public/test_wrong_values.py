"""Whatever a program puts into images, views and tracks: a wrong value is named where it goes in."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import csas_shadow_ros as csas
from csas_shadow_ros.core.geometry import GroundLattice, ShadowCamera, TrackPiece, ViewInfo
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.shape.volume import Volume

GRID = csas.GroundGrid.centred(8, 6, 0.1)
BAND = csas.Acoustics(60e3, 20e3, 1500.0, 1)
PIXELS = np.ones(GRID.shape, np.complex64)
IMAGE = csas.CoherentImage(PIXELS, GRID, BAND, 5_000)
CIRCLE = np.radians(np.arange(360.0))
PLACES = np.column_stack([30 * np.cos(CIRCLE), 30 * np.sin(CIRCLE), np.full(360, 12.0)])
STAMPS = np.arange(360) + 4_900
TRACK = csas.Track(STAMPS, PLACES)
CAMERA = ShadowCamera.from_ground([[0, -10, 3], [-10, 0, 4], [0, 0, 1]], (30.0, 0.0, 12.0), 8, 6)
INFO = ViewInfo(7, CAMERA, BAND, 0.0, 0.2)
VIEW = csas.View(INFO, np.ones((8, 6), np.float32))
SECTOR = Sector(PIXELS, GRID, BAND, 5, 0.0, 0.2)
LATTICE = GroundLattice.of(GRID)
VOLUME = Volume((0.0, 0.0, 0.05), 0.1, (2, 3, 4))
VOXELS = csas.VoxelGrid(
    VOLUME,
    np.zeros(VOLUME.shape, np.float32),
    np.ones(VOLUME.shape, np.uint16),
    0.5,
    np.ones(VOLUME.shape, bool),
)


def with_value(pixels, value):
    changed = pixels.copy()
    changed[3, 4] = value
    return changed


def track(stamps=STAMPS, positions=PLACES, **rest):
    return csas.Track(stamps, positions, **rest)


#: What is made, and what its error must name of it: the thing, the value, what was expected.
WRONG = {
    "pixels that are not a number": (
        lambda: replace(IMAGE, pixels=with_value(PIXELS, np.nan)),
        "image, 1 of 48 pixels not finite, row 3, column 4, nan, expected finite numbers",
    ),
    "infinite pixels": (lambda: replace(IMAGE, pixels=with_value(PIXELS, np.inf)), "image, inf, finite"),
    "real pixels": (lambda: replace(IMAGE, pixels=PIXELS.real), "image, float32, expected complex64"),
    "whole pixels": (lambda: replace(IMAGE, pixels=PIXELS.real.astype(int)), "image, int64, complex64"),
    "pixels as text": (lambda: replace(IMAGE, pixels=PIXELS.astype(str)), "image, <U, complex64"),
    "pixels as objects": (lambda: replace(IMAGE, pixels=PIXELS.astype(object)), "image, object, complex64"),
    "pixels as a list": (lambda: replace(IMAGE, pixels=PIXELS.tolist()), "image, list, expected an array"),
    "no pixels": (lambda: replace(IMAGE, pixels=None), "image, NoneType, expected an array"),
    "pixels of another shape": (lambda: replace(IMAGE, pixels=PIXELS.T), "image, (6, 8), (8, 6)"),
    "an image's grid": (lambda: replace(IMAGE, grid=(8, 6)), "grid, tuple, GroundGrid"),
    "an image's band": (lambda: replace(IMAGE, acoustics={}), "acoustics, dict, Acoustics"),
    "a fraction of a stamp": (lambda: replace(IMAGE, stamp_ns=12.5), "stamp, image, 12.5, whole"),
    "a stamp in seconds": (lambda: replace(IMAGE, stamp_ns=1.7e9), "stamp, image, 1700000000.0, whole"),
    "a stamp as text": (lambda: replace(IMAGE, stamp_ns="12"), "stamp, image, '12', whole"),
    "no stamp": (lambda: replace(IMAGE, stamp_ns=None), "stamp, image, None, whole"),
    "a stamp before 1970": (lambda: replace(IMAGE, stamp_ns=-1), "stamp, image, -1, [0"),
    "a stamp after 2038": (lambda: replace(IMAGE, stamp_ns=10**30), "stamp, image, 10000, [0"),
    "an image's frame": (lambda: replace(IMAGE, frame=None), "frame, image, None, name, csas_scene"),
    "a frame without a name": (lambda: replace(IMAGE, frame=" "), "frame, image, ' ', name"),
    "half a row": (lambda: replace(GRID, rows=8.5), "rows, 8.5, whole"),
    "rows as text": (lambda: replace(GRID, rows="8"), "rows, '8', whole"),
    "a spacing as text": (lambda: replace(GRID, spacing_m="0.1"), "pixel spacing, '0.1', number"),
    "a corner that is none": (lambda: replace(GRID, x_min_m=None), "corner, None, number"),
    "a corner that is not finite": (lambda: replace(GRID, y_max_m=math.nan), "corner, nan, finite"),
    "a band's frequency": (lambda: replace(BAND, centre_frequency_hz=None), "centre frequency, None, number"),
    "a sign as text": (lambda: replace(BAND, spectrum_sign="+1"), "spectrum_sign, '+1', -1"),
    "stamps of a track with fractions": (lambda: track(STAMPS + 0.5), "track, float64, 4900.5, whole"),
    "stamps of a track as text": (lambda: track(STAMPS.astype(str)), "stamps, track, <U, whole"),
    "stamps of a track that are none": (lambda: track(None), "stamps, track, whole"),
    "stamps of a track before 1970": (lambda: track(STAMPS - 5000), "stamp, track, -100, [0"),
    "positions as text": (lambda: track(positions=PLACES.astype(str)), "positions, track, <U, numbers"),
    "positions of two lengths": (lambda: track(positions=[[1], [1, 2]]), "positions, track, (n, 3)"),
    "complex positions": (lambda: track(positions=PLACES * 1j), "positions, track, complex128, numbers"),
    "a position that is not finite": (
        lambda: csas.Track(STAMPS[:9], with_value(np.ones((9, 5)), np.nan)[:, 2:]),
        "pose 3, nan",
    ),
    "a track's frame": (lambda: track(frame=3), "frame, track, 3, name"),
    "a break between poses": (lambda: track(breaks=[1.5]), "breaks, track, float64, 1.5, whole"),
    "a piece's stamps": (lambda: TrackPiece(STAMPS + 0.5, PLACES), "stamps, piece of a track, 4900.5"),
    "a piece's positions": (lambda: TrackPiece(STAMPS, PLACES.astype(str)), "positions, piece, <U"),
    "a view's pixels as a list": (lambda: replace(VIEW, pixels=[[1.0]]), "view, list, array"),
    "a view's pixels as text": (lambda: replace(VIEW, pixels=np.full((8, 6), "a")), "view, <U1, float32"),
    "a view's whole pixels": (lambda: replace(VIEW, pixels=np.ones((8, 6), int)), "view, int64, uint8"),
    "a view of another shape": (lambda: replace(VIEW, pixels=VIEW.pixels[1:]), "view, (7, 6), (8, 6)"),
    "a view's info": (lambda: replace(VIEW, info=None), "info, NoneType, ViewInfo"),
    "a view's stamp": (lambda: replace(INFO, stamp_ns=1.5), "stamp, view, 1.5, whole"),
    "a view's camera": (lambda: replace(INFO, camera=None), "camera, NoneType, ShadowCamera"),
    "a view's band": (lambda: replace(INFO, acoustics=None), "acoustics, NoneType, Acoustics"),
    "a view's aspect": (lambda: replace(INFO, aspect_rad=math.nan), "aspect, view, nan, finite"),
    "a view's aspect as text": (lambda: replace(INFO, aspect_rad="0"), "aspect, view, '0', number"),
    "a view's aperture": (lambda: replace(INFO, aperture_rad=-0.1), "aperture, view, -0.1, [0"),
    "a view's carrier": (lambda: replace(INFO, carrier_rad_m=(math.nan, 0)), "carrier, view, nan, finite"),
    "a carrier of one number": (lambda: replace(INFO, carrier_rad_m=3.0), "carrier, view, 3.0, two"),
    "a view's focus": (lambda: replace(INFO, focus_range_m="near"), "focus range, view, 'near', number"),
    "a view's frame": (lambda: replace(INFO, frame=""), "frame, view, '', name"),
    "a camera of nine numbers": (lambda: ShadowCamera(np.eye(3), 8, 6), "P, (3, 3), (3, 4)"),
    "a camera as text": (lambda: ShadowCamera("P", 8, 6), "P, 'P', (3, 4)"),
    "half a camera's row": (lambda: replace(CAMERA, rows=8.5), "rows, 8.5, whole"),
    "a sector's real pixels": (lambda: replace(SECTOR, pixels=PIXELS.real), "sector, float32, complex64"),
    "a sector's pixels as a list": (lambda: replace(SECTOR, pixels=[]), "sector, list, array"),
    "a sector's grid": (lambda: replace(SECTOR, grid=None), "grid, NoneType, GroundGrid"),
    "a sector's stamp": (lambda: replace(SECTOR, stamp_ns=0.5), "stamp, sector, 0.5, whole"),
    "a sector's aspect": (lambda: replace(SECTOR, aspect_rad=math.inf), "aspect, sector, inf, finite"),
    "a sector's frame": (lambda: replace(SECTOR, frame=b"x"), "frame, sector, b'x', name"),
    "a lattice's rows": (lambda: replace(LATTICE, rows=2.5), "rows, 2.5, whole"),
    "a lattice's step": (lambda: replace(LATTICE, row_step_m="ab"), "row step, 'ab', two numbers"),
    "a datum as text": (lambda: csas.Datum("48.4", 0.0), "latitude, '48.4', number"),
    "a datum without a longitude": (lambda: csas.Datum(48.4, None), "longitude, None, number"),
    "an altitude": (lambda: csas.Datum(48.4, 0.0, altitude_m="0"), "altitude, '0', number"),
    "a covariance": (lambda: csas.Datum(48.4, 0.0, covariance_m2=(1.0, 1.0)), "covariance, three"),
    "a volume's corner": (lambda: replace(VOLUME, origin_m=(0.0, 0.0)), "origin, (0.0, 0.0), three"),
    "half a voxel": (lambda: replace(VOLUME, shape=(1.5, 3, 4)), "voxels along z, 1.5, whole"),
    "a grid of another shape": (
        lambda: replace(VOXELS, likelihood=np.zeros((4, 3, 2), np.float32)),
        "likelihood, (4, 3, 2), (2, 3, 4)",
    ),
    "a grid's voxels": (
        lambda: replace(VOXELS, occupied=np.ones(VOLUME.shape)),
        "occupied, float64, expected bool",
    ),
    "sub-apertures of no image": (lambda: csas.SubApertures(None, TRACK), "image, NoneType, CoherentImage"),
    "sub-apertures of no track": (lambda: csas.SubApertures(IMAGE, None), "track, NoneType, Track"),
    "parameters of sub-apertures": (
        lambda: csas.SubApertures(IMAGE, TRACK, {}),
        "parameters, dict, SubApertureParameters",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_value_is_named_where_it_is_put_in(case):
    make, parts = WRONG[case]
    with pytest.raises(csas.CsasError) as caught:
        make()
    assert isinstance(caught.value, ValueError | TypeError)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 250
    for part in parts.split(", "):
        assert part.strip() in text, (part, text)


def test_an_array_in_the_place_of_a_number_is_cut_short():
    with pytest.raises(csas.CsasError) as caught:
        replace(GRID, rows=np.zeros((300, 300)))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


def test_a_pixel_spoiled_after_the_image_was_made_is_named_too(tiny_box_bag):
    run = tiny_box_bag.run
    spoiled = replace(run.image, pixels=run.image.pixels.copy())
    spoiled.pixels[3, 4] = np.nan
    with pytest.raises(csas.CsasError, match=r"image has 1 of \d+ pixels not finite, .*row 3, column 4"):
        csas.reconstruct(csas.Run.of(spoiled, run.track))


@pytest.mark.parametrize("kind", [np.complex64, np.complex128])
def test_whole_numbers_of_any_kind_and_both_precisions_are_taken(kind):
    grid = csas.GroundGrid.centred(np.int32(8), np.int64(6), np.float32(0.125))
    image = csas.CoherentImage(PIXELS.astype(kind), grid, BAND, np.int64(5))
    assert (image.stamp_ns, image.grid.rows) == (5, 8)
    assert type(image.stamp_ns) is type(image.grid.rows) is int


def test_a_blank_image_takes_no_memory_and_is_quickly_looked_at():
    grid = csas.GroundGrid.centred(1 << 16, 1 << 16, 0.01)
    blank = np.broadcast_to(np.complex64(0), grid.shape)  # 32 GiB, were it not one number
    assert csas.CoherentImage(blank, grid, BAND).pixels is blank
    with pytest.raises(csas.CsasError, match="not finite"):
        csas.CoherentImage(np.broadcast_to(np.complex64(np.nan), grid.shape), grid, BAND)


def test_numbers_too_large_to_sum_are_finite():
    csas.CoherentImage(np.full(GRID.shape, np.complex64(3e38)), GRID, BAND)


def test_a_track_leaves_its_makers_arrays_alone():
    stamps, places = STAMPS.copy(), PLACES.copy()
    made = csas.Track(stamps, places)
    stamps[0], places[0] = 0, 1.0
    assert made.stamps_ns[0] == STAMPS[0]
    assert np.array_equal(made.positions_m[0], PLACES[0])


def reason_of(call):
    with pytest.raises(csas.CsasError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize("off_s", [-3600, 3600])
def test_an_image_that_no_track_covers_is_refused_in_the_words_of_run(off_s, tiny_box_bag, tmp_path):
    image, track = tiny_box_bag.run.image, tiny_box_bag.run.track
    stray = replace(image, stamp_ns=image.stamp_ns + off_s * 10**9)
    told = reason_of(lambda: csas.reconstruct(csas.Run.of(stray, track)))
    assert reason_of(lambda: csas.reconstruct(SimpleNamespace(image=stray, track=track))) == told
    first, last = track.stamps_ns[[0, -1]]
    assert f"no track covers its stamp: the track covers {first} to {last} ns; it lies " in told
    csas.write_run(tmp_path / "stray", stray, track)
    of_bag = reason_of(lambda: csas.process_bag(tmp_path / "stray", tmp_path / "out", figures=False))
    fault = f": no full-circle image can be used: {{}}image{{}} ({stray.stamp_ns} ns): no track covers its"
    assert told.startswith(f"in memory{fault.format('', '')}")
    assert of_bag.startswith(f"{tmp_path / 'stray'}{fault.format('/csas/', ' message 0')}")
    assert of_bag.partition("no track covers")[2] == told.partition("no track covers")[2]


def test_an_image_of_the_circle_s_first_and_last_degrees_is_taken(tiny_box_bag):
    image, track = tiny_box_bag.run.image, tiny_box_bag.run.track
    step = int(track.stamps_ns[1] - track.stamps_ns[0])  # half a degree
    for stamp in (track.stamps_ns[0] - 5 * step, track.stamps_ns[-1] + 5 * step, 0):
        csas.Run.of(replace(image, stamp_ns=stamp), track)


def test_anything_with_an_image_and_a_track_is_taken(tiny_box_bag):
    run = tiny_box_bag.run
    made = SimpleNamespace(image=run.image, track=run.track)
    assert csas.reconstruct(made, csas.parameters(step_deg=30, voxel_size_m=0.1)).views_used == 12
