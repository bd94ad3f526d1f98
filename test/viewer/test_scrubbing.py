"""Turning the circle: what is shown of every view is decoded while the circle is left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from synthetic import COUNT, PIXELS, entry

from csas_shadow_ros.viewer.store import Entry, ViewStore

#: The picture of a view by hand, into a canvas of its own: of the part that is decoded, or of the whole.
PAINTED = """async (whole) => {
  const p = csas.panels[1], view = csas.views("shadow")[20], address = csas.address("shadow", view, "jpg");
  const part = csas.loader.partOf;
  if (whole) csas.loader.partOf = () => undefined;
  const bitmap = await csas.loader.pixels(address);
  csas.loader.partOf = part;
  const side = 300, canvas = new OffscreenCanvas(side, side), radius = 140;
  p.found = { about: view, view, bitmap };
  p.paint({ canvas, side, radius, k: 1 });
  const { data } = canvas.getContext("2d").getImageData(0, 0, side, side), seen = [];
  for (let y = 0; y < side; y++) for (let x = 0; x < side; x++)
    if (Math.hypot(x + 0.5 - side / 2, y + 0.5 - side / 2) < radius) seen.push(data[4 * (y * side + x)]);
  return [bitmap.codes.length, seen];
}"""


def store_of_slopes() -> ViewStore:
    """Views that get brighter to one corner, so that a shift of a pixel is seen."""
    store = ViewStore(title="slopes")
    v, u = np.indices((PIXELS, PIXELS))
    codes = (40 + u + v // 2).astype(np.uint8)
    for i in range(COUNT):
        info = entry(i).info
        for name in ("sub_aperture", "shadow"):
            store.put_view(name, Entry(info, f"{i}", lambda: codes))
    return store


def alone(watched: Any) -> None:
    """Leave the circle alone until every view is decoded."""
    watched.until(
        "csas.idle() && csas.loader.filled && !csas.loader.ahead.length && !csas.loader.busy.size"
        " && csas.views('shadow').every(v => csas.loader.bitmap(csas.address('shadow', v, 'jpg')))"
    )


def test_a_circle_that_was_left_alone_turns_without_decoding(watched: Any, serve: Any) -> None:
    watched.open(serve(store_of_slopes()))
    alone(watched)
    watched.js(
        "(() => { csas.made = []; const old = csas.loader.pixels.bind(csas.loader);"
        " csas.loader.pixels = (a) => { csas.made.push(a); return old(a); }; })()"
    )
    late = watched.js(
        """(async () => { let late = 0; for (let i = 0; i < 90; i++) { csas.setAspect(4 * i); csas.draw();
        late += csas.panels.some(p => p.found.late || p.found.partly || !p.found.bitmap);
        await new Promise(requestAnimationFrame); } return late; })()"""
    )
    assert late == 0
    assert [a for a in watched.js("csas.made") if a.endswith(".jpg")] == []
    # More of the scene is shown: it is decoded anew.
    watched.js("csas.state.zoom = 0.5, csas.dirty()")
    watched.drawn()
    assert not watched.js(
        "csas.views('shadow').every(v => csas.loader.covered(csas.address('shadow', v, 'jpg')))"
    )
    alone(watched)


def test_the_decoded_part_is_the_picture(watched: Any, serve: Any) -> None:
    watched.open(serve(store_of_slopes()))
    watched.until("csas.loader.filled")
    for zoom, centre in ((1, "0, 0"), (3, "0.7, -0.3"), (0.5, "1.5, 1")):
        watched.js(f"csas.state.zoom = {zoom}, csas.state.centre = [{centre}]")
        size, part = watched.page.evaluate(PAINTED, False)
        whole_size, whole = watched.page.evaluate(PAINTED, True)
        assert whole_size == PIXELS**2
        assert size < whole_size or zoom < 1
        assert max(whole) > min(whole)
        assert part == whole


def test_a_picture_that_is_asked_for_twice_at_once_comes_twice(watched: Any, serve: Any) -> None:
    """By its address alone the first question would never be answered."""
    watched.open(serve(store_of_slopes()))
    watched.until("csas.loader.filled")
    sizes = watched.page.evaluate(
        "async () => { const a = csas.address('shadow', csas.views('shadow')[20], 'jpg');"
        " const twice = Promise.all([csas.loader.pixels(a), csas.loader.pixels(a)]);"
        " const made = await Promise.race([twice, new Promise((done) => setTimeout(() => done([]), 10000))]);"
        " return made.map((one) => one.codes.length); }"
    )
    assert len(sizes) == 2
    assert sizes[0] == sizes[1] > 0


def test_no_more_is_decoded_ahead_than_there_is_room_for(watched: Any, serve: Any) -> None:
    watched.open(serve(store_of_slopes()))
    watched.js("csas.loader.room = 200000, csas.dirty()")
    watched.until("csas.idle() && csas.loader.filled && !csas.loader.ahead.length && !csas.loader.busy.size")
    assert watched.js("csas.loader.decoded") <= 200000
    watched.js("csas.setAspect(180)")
    watched.settle()
    assert watched.js("csas.loader.decoded") <= 200000


def test_asking_whether_the_circle_is_left_alone_keeps_nothing_from_being_decoded(
    watched: Any, serve: Any
) -> None:
    watched.open(serve(store_of_slopes()))
    alone(watched)
    watched.js(
        "(() => { for (const a of [...csas.loader.bitmaps.keys()]) csas.loader.forget(a);"
        " csas.moved = performance.now(); csas.prefetch(); setInterval(() => csas.idle(), 1); })()"
    )
    alone(watched)


def test_a_list_that_holds_nothing_new_is_told_as_filled(watched: Any, serve: Any) -> None:
    watched.open(serve(store_of_slopes()))
    alone(watched)
    watched.js(
        "(() => { csas.loader.told = 0; const old = csas.loader.changed;"
        " csas.loader.changed = (a) => { csas.loader.told += !a; old(a); };"
        " csas.loader.fetchAll([...csas.loader.blobs.keys()]); })()"
    )
    assert watched.js("csas.loader.told") == 1


def test_a_circle_that_has_no_room_yet_draws_nothing_and_says_nothing(watched: Any, serve: Any) -> None:
    """A small screen lays its pictures out after the first evidence has come."""
    watched.open(serve(store_of_slopes()))
    watched.until("csas.loader.filled")
    watched.js(
        "(() => { const s = csas.panels[0].slider, side = s.side;"
        " s.evidence = { heights: [[0, 0.3, 0.1]], median: 0.3, refused: [], worst: 1 };"
        " s.side = 0; s.background = undefined; s.drawRing(); s.side = side; s.evidence = null; })()"
    )
