# What is asked of the page is JavaScript, and stays in one piece.
# ruff: noqa: E501
"""The page in a browser: every interaction, on views that tell which they are and on a real run."""

from __future__ import annotations

import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from synthetic import COUNT, PIXELS, code_of, entry

from csas_shadow_ros.cli import main
from csas_shadow_ros.core.imaging.mask_codes import MASK_SHADOW
from csas_shadow_ros.core.shape.mesh import mesh_from_grid
from csas_shadow_ros.viewer.export import export_html
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.store import Entry, ViewStore

#: Where screenshots go: the README's are made by this run (CSAS_SCREENSHOTS=docs/figures).
SCREENSHOTS = os.environ.get("CSAS_SCREENSHOTS", "")


def picture(watched: Any, name: str) -> None:
    if SCREENSHOTS:
        watched.page.screenshot(path=str(Path(SCREENSHOTS) / f"viewer_{name}.png"))


def store_of(indices: Any = range(COUNT)) -> ViewStore:
    store = ViewStore(title="synthetic", live=True)
    for i in indices:
        for name in ("sub_aperture", "shadow"):
            store.put_view(name, entry(i))
    return store


def shown(watched: Any) -> list[float]:
    """The aspect that each picture's grey, its label and its ARIA value tell; they must agree."""
    watched.settle()
    told = []
    for panel in (0, 1):
        grey, label, aria = watched.js(
            f"""(() => {{ const p = csas.panels[{panel}], c = p.slider.picture, g = c.getContext("2d");
            return [g.getImageData(c.width * 0.5 + 20, c.height * 0.5 + 33, 1, 1).data[0], p.note.textContent,
                    +p.slider.getAttribute("aria-valuenow")]; }})()"""
        )
        top, span = watched.js("[csas.state.top, csas.state.range]")
        low, high = ((db + 32) / 0.25 + 1 for db in (top - span, top))
        greys = [255 * min(1, max(0, (code_of(i) - low) / (high - low))) for i in range(COUNT)]
        by_grey = int(np.argmin([abs(v - grey) for v in greys])) * 360 / COUNT
        assert abs(by_grey - aria) <= 360 / COUNT, (grey, aria)
        assert float(re.match(r"[\d.]+", label)[0]) == pytest.approx(aria)
        assert watched.page.locator("#where").inner_text().startswith(f"aspect {aria:.1f}°")
        told.append(aria)
    return told


def ring_point(watched: Any, aspect_deg: float, panel: int = 1) -> tuple[float, float]:
    x, y, side, radius = watched.js(
        f"""(() => {{ const s = csas.panels[{panel}].slider, b = s.ring.getBoundingClientRect();
        return [b.left, b.top, s.side, s.radius]; }})()"""
    )
    a = math.radians(aspect_deg)
    return x + side / 2 + radius * math.cos(a), y + side / 2 - radius * math.sin(a)


def middle(watched: Any, panel: int = 1) -> tuple[float, float]:
    b = watched.js(f"csas.panels[{panel}].slider.ring.getBoundingClientRect().toJSON()")
    return round(b["x"] + b["width"] / 2), round(b["y"] + b["height"] / 2)


def test_click_drag_wheel_and_keys_choose_the_view_that_picture_label_and_aria_tell(watched, serve):
    watched.open(serve(store_of()))
    watched.js("csas.state.top = 31, csas.state.range = 60, csas.dirty()")
    page = watched.page
    assert shown(watched) == [0, 0]
    page.mouse.click(*ring_point(watched, 120))
    assert shown(watched) == [120, 120]
    page.mouse.move(*ring_point(watched, 120))
    page.mouse.down()
    for aspect in range(120, 201, 8):
        page.mouse.move(*ring_point(watched, aspect))
    page.mouse.up()
    assert shown(watched) == [200, 200]
    page.mouse.wheel(0, -100)
    assert shown(watched) == [204, 204]
    page.mouse.wheel(0, 100)
    assert shown(watched) == [200, 200]
    page.mouse.click(*ring_point(watched, 0, panel=0))
    page.keyboard.press("ArrowLeft")
    assert shown(watched) == [356, 356]  # across 0
    page.keyboard.press("ArrowRight")
    assert shown(watched) == [0, 0]
    page.keyboard.press("Shift+ArrowUp")
    assert shown(watched) == [40, 40]
    page.keyboard.press("PageDown")
    assert shown(watched) == [0, 0]
    page.keyboard.press("End")
    assert shown(watched) == [356, 356]
    page.keyboard.press("Home")
    assert shown(watched) == [0, 0]
    page.mouse.move(*ring_point(watched, 350))
    page.mouse.down()
    page.mouse.move(*ring_point(watched, 8))
    page.mouse.up()
    assert shown(watched) == [8, 8]


def test_play_goes_on_by_itself_and_stops(watched, serve):
    watched.open(serve(store_of()))
    watched.page.keyboard.press("Space")
    watched.until("csas.state.aspect > 20")
    watched.page.keyboard.press("Space")
    watched.until("!csas.playing")
    watched.drawn()
    stopped = watched.js("csas.state.aspect")
    watched.page.wait_for_timeout(400)
    assert watched.js("csas.state.aspect") == stopped


def test_views_that_have_not_arrived_are_a_gap_that_a_live_run_fills(watched, serve):
    store = store_of(range(30))  # 0 to 116 degrees
    watched.open(serve(store))

    def bright(aspect: float) -> str:
        k = f"csas.panels[1].slider, a = {math.radians(aspect)}, c = s.ring, f = c.width / s.side"
        pixel = "c.width / 2 + f * s.radius * Math.cos(a), c.width / 2 - f * s.radius * Math.sin(a), 1, 1"
        return (
            f"(() => {{ const s = {k}; return c.getContext('2d').getImageData({pixel}).data[0]; }})() > 100"
        )

    watched.settle()
    assert watched.js(bright(62))
    assert not watched.js(bright(222))
    for i in range(30, COUNT):
        store.put_view("shadow", entry(i))
        store.put_view("sub_aperture", entry(i))
    watched.until(f"csas.views('shadow').length === {COUNT}")
    watched.until(bright(222))
    store.put_view("shadow", entry(0, code=200))  # a new revision of the view that is shown
    watched.until(
        "csas.panels[1].found.about.rev === csas.sameStamp('shadow', csas.current).rev && csas.panels[1].found.exact"
    )


def test_zoom_and_pan_are_linked_and_sonar_up_turns_the_shadow_downwards(watched, serve, run_store):
    watched.open(serve(run_store))
    page = watched.page
    page.keyboard.press("0")  # the whole scene
    x, y = middle(watched)
    page.mouse.move(x + 40, y)
    before = watched.js("csas.state.zoom")
    under = f"csas.panels[1].toScene({{clientX: {x + 40}, clientY: {y}}})"
    fixed = watched.js(under)
    page.mouse.wheel(0, -100)
    watched.until(f"csas.state.zoom > {before}")
    assert watched.js(under) == pytest.approx(fixed, abs=1e-6), "what is under the pointer stays there"
    page.mouse.down()
    page.mouse.move(x + 70, y + 20)
    page.mouse.up()
    left, top = middle(watched, 0)
    moved = watched.js(f"csas.panels[0].toScene({{clientX: {left + 70}, clientY: {top + 20}}})")
    assert moved == pytest.approx(fixed, abs=0.01), "the other picture shows the same place"
    page.keyboard.press("0")
    assert watched.js("csas.state.zoom") == 1
    page.keyboard.press("n")
    watched.js("csas.setAspect(70)")
    watched.settle()
    # Away from the sonar is down.
    down = watched.js(
        "(() => { const [a, b, c, d] = csas.panels[1].ground(csas.current), t = csas.current.aspect_deg * Math.PI / 180;"
        " return [-(a * Math.cos(t) + c * Math.sin(t)), -(b * Math.cos(t) + d * Math.sin(t))]; })()"
    )
    assert abs(down[0]) < 1e-6 * down[1]
    page.keyboard.press("Alt+ArrowRight")
    assert watched.js("csas.state.centre[0]") > 0


def test_every_layer_shows_a_picture_and_the_range_changes_it(watched, serve, run_store):
    watched.open(serve(run_store))
    page, seen = watched.page, set()
    for key in "123456":
        page.keyboard.press(key)
        watched.until(
            "csas.panels[1].found?.bitmap && csas.panels[1].found.exact && !csas.panels[1].found.late", 30
        )
        watched.drawn()
        data = watched.js("csas.panels[1].slider.picture.toDataURL()")
        assert data not in seen
        seen.add(data)
    picture(watched, "colour_by_aspect")
    page.keyboard.press("4")
    watched.until("csas.panels[1].about.textContent === '4° wide'")
    page.keyboard.press("Shift+2")
    watched.until("csas.panels[0].layer === 'shadow'")
    page.keyboard.press("2")
    watched.settle()

    level = (
        "(() => { const c = csas.panels[1].slider.picture, d = c.getContext('2d').getImageData(c.width * .4, c.height * .7, 60, 60).data;"
        " let s = 0; for (let i = 0; i < d.length; i += 4) s += d[i]; return s * 4 / d.length; })()"
    )
    page.keyboard.press("c")
    watched.until("!csas.state.contour")
    watched.drawn()
    first = watched.js(level)
    for _ in range(6):
        page.keyboard.press("Shift+BracketLeft")
    watched.until(f"{level} > {first + 5}")  # a lower brightest level shows brighter


def test_the_ruler_reads_a_shadow_and_the_height_that_it_implies(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.js("csas.setAspect(90)")
    watched.settle()
    watched.page.keyboard.press("r")
    x, y = middle(watched)
    watched.page.mouse.move(x, y + 5)
    watched.page.mouse.down()
    watched.page.mouse.move(x, y + 85)
    watched.page.mouse.up()
    watched.drawn()
    a, b = watched.js("csas.ruler.ends")
    sonar = np.array(watched.js("csas.current.sonar"))
    # Independently: the ray from the sonar to the tip passes over the start at this height.
    tip, start = np.array(b), np.array(a)
    far, near = np.linalg.norm(tip - sonar[:2]), np.linalg.norm(start - sonar[:2])
    height = sonar[2] * (far - near) / far
    text = watched.page.locator("#measured").inner_text()
    assert "h = L · tan ψ" in text
    assert float(re.search(r"= ([\d.]+) m \(ψ", text)[1]) == pytest.approx(height, abs=0.006)
    assert float(text.split(" m;")[0]) == pytest.approx(np.linalg.norm(tip - start), abs=0.006)
    picture(watched, "ruler")


def test_the_shadow_of_the_mesh_is_p_times_x(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.until("csas.solid.sides.main.triangles > 0")
    watched.js("csas.setAspect(135)")
    watched.page.keyboard.press("m")
    lines = np.array(watched.until("(l => l && l.length ? Array.from(l) : 0)(csas.castLines(csas.current))"))
    stamp = int(watched.js("csas.current.stamp"))
    camera = run_store.entry("shadow", stamp).info.camera
    mesh = mesh_from_grid(run_store.grids["main"])
    expected = camera.project(mesh.vertices)
    assert lines[0::2].min() == pytest.approx(expected[:, 0].min(), abs=2.5)
    assert lines[0::2].max() == pytest.approx(expected[:, 0].max(), abs=2.5)
    assert lines[1::2].min() == pytest.approx(expected[:, 1].min(), abs=2.5)
    assert lines[1::2].max() == pytest.approx(expected[:, 1].max(), abs=2.5)


def test_the_surface_follows_the_threshold_and_stays_near_the_measured_one(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.until("csas.solid.sides.main.triangles > 0 && csas.solid.sides.other.triangles > 0")
    page = watched.page
    for name in ("main", "other"):
        exact = len(mesh_from_grid(run_store.grids[name]).faces)
        assert watched.js(f"csas.solid.sides.{name}.triangles") == pytest.approx(exact, rel=0.3)
    points = np.array(
        watched.js("Array.from(csas.solid.sides.main.mesh.geometry.attributes.position.array)")
    ).reshape(-1, 3)
    faces = np.array(watched.js("Array.from(csas.solid.sides.main.mesh.geometry.index.array)")).reshape(-1, 3)
    mesh = trimesh.Trimesh(points, faces)
    shared = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    assert (shared % 2 == 0).all(), "the surface is closed"
    assert mesh.volume == pytest.approx(mesh_from_grid(run_store.grids["main"]).volume, rel=0.15)
    before = watched.js("csas.solid.sides.main.triangles")
    page.keyboard.press("t")
    for _ in range(12):
        page.keyboard.press("ArrowLeft")
    watched.until(f"csas.solid.sides.main.triangles !== {before}")
    watched.until(
        "csas.surfaceMeasures?.object && document.querySelector('#dimensions').innerText.includes('surface here')"
    )
    colours = watched.js(
        "(() => { csas.solid.render(); const c = document.createElement('canvas'); c.width = c.height = 100; const g = c.getContext('2d');"
        " g.drawImage(csas.solid.canvas, 0, 0, 100, 100); return new Set(g.getImageData(0, 0, 100, 100).data).size; })()"
    )
    assert colours > 20, "the 3-D picture is not blank"


def test_soft_and_hard_stand_side_by_side_with_evidence_track_and_dimensions(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.until("csas.solid.sides.other.triangles > 0")
    page = watched.page
    for key in "bv":
        page.keyboard.press(key)
    watched.until(
        "csas.state.compare && csas.solid.sides.main.points.geometry.attributes.position?.count > 50"
    )
    assert page.locator("#tag-main").inner_text() == "Silhouettes"
    assert page.locator("#tag-other").inner_text() == "Soft carving"
    text = page.locator("#dimensions").inner_text()
    assert re.search(r"Length\s+[\d.]+ ± [\d.]+ m", text), text
    assert re.search(r"Height\s+[\d.]+ ± [\d.]+ m", text), text
    page.keyboard.press("v")
    page.keyboard.press("k")
    sonar = watched.js("csas.solid.sides.main.sonar.position.toArray()")
    assert sonar == pytest.approx(watched.js("csas.current.sonar"))
    assert watched.js("csas.solid.sides.main.track.geometry.attributes.position.count") > 100
    page.keyboard.press("k")
    watched.js("csas.solid.whole(false), csas.setAspect(70)")
    page.keyboard.press("m")
    watched.settle()
    page.wait_for_timeout(1200)
    picture(watched, "run")


def test_picture_mesh_link_and_file_can_be_taken_away(watched, serve, run_store, tmp_path):
    watched.open(serve(run_store))
    page = watched.page
    watched.js("csas.setAspect(45), csas.zoomBy(2)")
    watched.settle()
    with page.expect_download() as taken:
        page.keyboard.press("s")
    taken.value.save_as(tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"
    with page.expect_download() as taken:
        page.select_option("#save-mesh", "stl")
    taken.value.save_as(tmp_path / "m.stl")
    expected = mesh_from_grid(run_store.grids["main"])
    assert trimesh.load_mesh(tmp_path / "m.stl").volume == pytest.approx(expected.volume, rel=1e-4)
    page.keyboard.press("l")
    watched.until("decodeURIComponent(location.hash) === decodeURIComponent(csas.link())")
    link = page.url
    watched.js("csas.setAspect(200), csas.fit()")
    page.wait_for_timeout(400)
    page.goto("about:blank")
    watched.open(link)
    assert watched.js("[csas.state.aspect, csas.state.zoom]") == [45, 2]


def test_every_key_of_the_help_does_what_it_says(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.until("csas.volumes.main && csas.volumes.other")
    watched.page.keyboard.press("Tab")  # the first button: keys work wherever the focus is
    keys_turn_and_switch(watched)
    keys_move_the_picture(watched)
    keys_choose_layers_and_measure(watched)


def press(watched, key):
    """Press a key, and wait until what it changes is drawn."""
    watched.page.keyboard.press(key)
    watched.drawn()


def keys_turn_and_switch(watched):
    js = watched.js
    step = 360 / js("csas.views('shadow').length")
    for key, views in (
        ("ArrowRight", 1),
        ("ArrowLeft", 0),
        ("Shift+ArrowRight", 10),
        ("Home", 0),
        ("End", -1),
    ):
        press(watched, key)
        assert js("csas.current.aspect_deg") == pytest.approx(views * step % 360), key
    for key, expression, before, after in (
        ("n", "csas.state.orientation", "north", "sonar"),
        ("c", "csas.state.contour", True, False),
        ("m", "csas.state.cast", False, True),
        ("b", "csas.state.compare", False, True),
        ("o", "csas.state.overlay", False, True),
        ("v", "csas.state.evidence", False, True),
        ("k", "document.querySelector('#whole').checked", False, True),
        ("r", "csas.state.ruling", False, True),
    ):
        assert js(expression) == before
        press(watched, key)
        assert js(expression) == after, key
        press(watched, key)
        assert js(expression) == before, key


def keys_move_the_picture(watched):
    js = watched.js
    press(watched, "0")
    press(watched, "+")
    assert js("csas.state.zoom") == pytest.approx(1.25)
    centre = js("csas.state.centre")
    press(watched, "Alt+ArrowRight")
    assert js("csas.state.centre[0]") > centre[0]
    press(watched, "Alt+ArrowUp")
    assert js("csas.state.centre[1]") > centre[1]
    press(watched, "-")
    assert js("csas.state.zoom") == pytest.approx(1.0)
    press(watched, "0")
    assert js("[csas.state.zoom, ...csas.state.centre]") == [1, 0, 0]
    span, top = js("[csas.state.range, csas.state.top]")
    for key, wanted in (
        ("BracketRight", [span + 2, top]),
        ("BracketLeft", [span, top]),
        ("Shift+BracketRight", [span, top + 1]),
        ("Shift+BracketLeft", [span, top]),
    ):
        press(watched, key)
        assert js("[csas.state.range, csas.state.top]") == wanted, key


def keys_choose_layers_and_measure(watched):
    js = watched.js
    for number, layer in enumerate(js("[...csas.panels[0].select.options].map(o => o.value)"), start=1):
        if layer == "reduced":
            continue  # asks the server for what a run without its image has not
        press(watched, f"Digit{number}")
        press(watched, f"Shift+Digit{number}")
        assert js("csas.panels.map(p => p.layer)") == [layer, layer]
    press(watched, "r")
    press(watched, "ArrowUp")
    before = js("csas.ruler.ends[1]")
    press(watched, "ArrowRight")
    assert js("csas.ruler.ends[1][0]") > before[0]
    press(watched, "Delete")
    assert js("csas.allRulers().length") == 0
    press(watched, "z")
    assert js("csas.state.centre") == pytest.approx(js("csas.contact.position_m"))
    press(watched, "0")
    press(watched, "t")
    surfaces, threshold = js("[csas.stats.surfaces.length, +document.activeElement.value]")
    press(watched, "ArrowRight")
    assert js("+document.activeElement.value") > threshold
    watched.until(f"csas.stats.surfaces.length > {surfaces}")


def store_of_shadows() -> ViewStore:
    """Grey views, each with a square shadow of 1 m."""
    store = store_of()
    mask = np.zeros((PIXELS, PIXELS), np.uint8)
    mask[38:58, 38:58] = MASK_SHADOW
    for i in range(COUNT):
        store.put_view("shadow_mask", Entry(entry(i).info, "1", lambda: mask))
    return store


def test_outlines_are_there_before_their_views_are_gone_to_and_lie_on_the_shadows_edge(watched, serve):
    watched.open(serve(store_of_shadows()))
    watched.until(f"csas.loader.outlines.size === {COUNT}")
    for aspect in (0, 40, 200):
        watched.js(f"csas.setAspect({aspect})")
        watched.settle()
        # How far pixels of the outline's colour are from the square's edge, in the view's pixels.
        off = watched.js(
            """(() => { const p = csas.panels[1], c = p.slider.picture, d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data, A = csas.current.A, out = [];
            const T = p.ground(csas.current), det = T[0] * T[3] - T[1] * T[2];
            for (let i = 0; i < d.length; i += 4) if (d[i] - d[i + 2] > 150) {
              const h = (i / 4) % c.width + 0.5 - T[4], v = Math.floor(i / 4 / c.width) + 0.5 - T[5], x = (T[3] * h - T[2] * v) / det, y = (T[0] * v - T[1] * h) / det;
              const u = A[0] * x + A[1] * y + A[2], w = A[3] * x + A[4] * y + A[5];
              out.push(Math.max(Math.abs(u - 47.5), Math.abs(w - 47.5)));
            } return out; })()"""
        )
        assert len(off) > 200
        assert np.median(off) == pytest.approx(9.5, abs=0.3)
        assert np.ptp(off) < 1.5


def test_the_cursor_is_on_paper_too(watched, serve):
    watched.open(serve(store_of()))
    watched.settle()
    green = "(() => { const c = csas.panels[1].slider.ring, d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i] === 41 && d[i + 1] === 216 && d[i + 2] === 90) n++; return n; })()"
    assert watched.js(green) == 0, "what moves is no part of the circle on the screen"
    watched.js("dispatchEvent(new Event('beforeprint'))")
    assert watched.js(green) > 100
    watched.js("dispatchEvent(new Event('afterprint'))")
    assert watched.js(green) == 0


def test_pictures_come_on_paper_as_images_with_their_circle(watched, serve):
    """A browser prints no pixels that were put on a canvas, and prints a cleared circle over it as white."""
    watched.open(serve(store_of()))
    watched.js("csas.state.top = 31, csas.state.range = 60, csas.setAspect(180)")
    watched.settle()
    watched.js(
        """(() => { csas.put = 0; const picture = csas.panels[1].slider.picture, g = picture.getContext('2d'), put = g.putImageData.bind(g);
        g.putImageData = (...a) => { csas.put++; put(...a); }; })()"""
    )
    at = "(() => { const p = csas.panels[1].slider, c = p.picture, k = c.width / p.side, [x, y] = p.cursor, g = c.getContext('2d'); return [[c.width / 2 + 20, c.height / 2 + 33], [x * k, y * k]].map(q => [...g.getImageData(...q, 1, 1).data].slice(0, 3)); })()"
    middle, _ = watched.js(at)
    assert middle[0] > 20
    watched.js("dispatchEvent(new Event('beforeprint'))")
    assert watched.js("csas.put") == 0
    assert watched.js(at) == [middle, [41, 216, 90]]
    watched.page.emulate_media(media="print")
    assert watched.js("getComputedStyle(csas.panels[1].slider.ring).visibility") == "hidden"
    watched.page.emulate_media(media="screen")
    watched.js("dispatchEvent(new Event('afterprint'))")
    watched.drawn()
    assert watched.js("csas.put") > 0
    assert watched.js(at)[1] != [41, 216, 90]


def test_after_a_click_on_a_box_or_a_button_the_keys_still_work(watched, serve):
    watched.open(serve(store_of()))
    page = watched.page
    page.click("#contour")
    page.click("#contour")
    page.keyboard.press("ArrowRight")
    assert shown(watched) == [4, 4]
    page.click("#fit")
    page.keyboard.press("Space")
    watched.until("csas.playing && csas.state.aspect > 20")
    page.keyboard.press("Space")
    assert watched.js("!csas.playing && csas.state.contour")


def test_arrows_move_what_is_on_the_screen_whatever_is_up(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.js("csas.state.orientation = 'sonar', csas.setAspect(250)")
    watched.drawn()
    for key, axis, sign in (("Right", 0, 1), ("Left", 0, -1), ("Up", 1, -1), ("Down", 1, 1)):
        a, b, c, d, *_ = watched.js("csas.panels[1].ground(csas.current)")
        x0, y0 = watched.js("csas.state.centre")
        watched.page.keyboard.press(f"Alt+Arrow{key}")
        watched.drawn()
        x, y = (v - w for v, w in zip(watched.js("csas.state.centre"), (x0, y0), strict=True))
        moved = (a * x + c * y, b * x + d * y)  # canvas pixels, y downwards
        assert sign * moved[axis] > 5, key
        assert abs(moved[1 - axis]) < 1e-6 * abs(moved[axis]), key


def end_of(server: ViewerServer, watched: Any) -> None:
    server.stop()
    watched.until("document.querySelector('#link').textContent.includes('away')")


def forgive_the_pause(watched: Any) -> None:
    """Forget what the browser says while there is no server."""
    watched.said[:] = [s for s in watched.said if "WebSocket" not in s and "ERR_CONNECTION_REFUSED" not in s]


def test_another_run_at_the_same_address_leaves_nothing_of_the_first(watched, serve, run_store):
    first = ViewerServer(run_store)
    first.start()
    watched.open(first.url)
    watched.until("csas.solid.sides.main.triangles > 0 && csas.surfaceMeasures")
    end_of(first, watched)
    other = store_of()
    other.title = "another run"
    serve(other, port=first.port)
    watched.until("document.querySelector('#title').textContent === 'another run'")
    watched.until("csas.views('shadow').length === 90")
    assert watched.js("[csas.solid.sides.main.mesh.visible, csas.solid.sides.other.mesh.visible]") == [
        False,
        False,
    ]
    assert "surface here" not in watched.page.locator("#dimensions").inner_text()
    for row in ("#row-main", "#row-other"):
        assert not watched.page.locator(row).is_visible()
    forgive_the_pause(watched)


def test_a_run_of_likelihoods_alone_shows_them(watched, serve):
    store = ViewStore(title="likelihoods")
    for i in range(COUNT):
        store.put_view("likelihood", entry(i))
    watched.open(serve(store))
    assert watched.js("csas.panels.map(p => p.layer)") == ["likelihood", "likelihood"]
    watched.settle()


def test_a_link_that_was_edited_gives_defaults_for_what_it_breaks(watched, serve):
    url = serve(store_of())
    watched.open(f'{url}#{{"layers":null,"aspect":"a","zoom":2,"centre":[1],"range":1e999,"strange":1}}')
    assert watched.js("[csas.state.zoom, csas.state.aspect, ...csas.state.centre]") == [2, 0, 0, 0]
    assert shown_layers(watched) == ["sub_aperture", "shadow"]


def shown_layers(watched: Any) -> list[str]:
    return watched.js("csas.panels.map(p => p.layer)")


def test_a_range_beyond_the_lowest_level_is_not_claimed(watched, serve):
    watched.open(serve(store_of()))
    watched.js("csas.state.range = 60, csas.state.top = 0, csas.sayLevels()")
    assert watched.page.locator("#range-db + output").inner_text() == "32 dB"


def test_what_is_damaged_is_said_on_the_page(watched, serve):
    store = store_of()
    url = serve(store)
    watched.open(url)
    assert not watched.page.locator("#damage").is_visible()
    store.put_part("damage", "result.mcap: damaged at byte 17")
    watched.until("!document.querySelector('#damage').hidden")
    assert "byte 17" in watched.page.locator("#damage").inner_text()


def test_two_fingers_come_closer(watched, serve):
    watched.open(serve(store_of()))
    touch = watched.page.context.new_cdp_session(watched.page)
    x, y = middle(watched)

    def fingers(kind: str, apart: int) -> None:
        points = [{"x": x + side * apart, "y": y, "id": (side + 1) // 2} for side in (-1, 1)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points if apart else []})

    fingers("touchStart", 20)
    for apart in range(25, 61, 5):
        fingers("touchMove", apart)
    fingers("touchEnd", 0)
    watched.drawn()
    assert watched.js("csas.state.zoom") == pytest.approx(3.0, rel=0.05)
    held = watched.js("csas.state.centre")
    assert held == pytest.approx([0, 0], abs=0.2 * watched.js("csas.sceneRadius"))


def test_the_command_line_writes_a_page_that_opens_without_a_server(watched, results, run_store, tmp_path):
    path = tmp_path / "run.html"
    assert main(["view", str(results), "--html", str(path), "--every", "6", "-q"]) == 0
    watched.open(path.as_uri())
    assert watched.js("csas.views('shadow').length") == math.ceil(len(run_store.sets["shadow"]) / 6)
    watched.until("csas.panels.every(p => p.found?.bitmap && !p.found.late)")
    assert not watched.page.locator("#save-mesh").is_visible()  # the server would make it


def test_one_html_file_opens_without_a_server(watched, run_store, tmp_path):
    path = tmp_path / "run.html"
    path.write_bytes(export_html(run_store, 4))
    watched.open(path.as_uri())
    watched.until("csas.solid.sides.main.triangles > 0")
    watched.js("csas.setAspect(100)")
    watched.until(
        "csas.panels.every(p => p.found?.bitmap && !p.found.late) && csas.current.aspect_deg === 100"
    )
    assert [a for a in watched.asked if not a.startswith(("file:", "data:", "blob:"))] == []


def test_keys_open_the_help_and_a_tablet_has_room_for_everything(watched, serve, run_store):
    watched.open(serve(run_store))
    page = watched.page
    page.keyboard.press("?")
    assert page.locator("#help").is_visible()
    picture(watched, "help")
    page.keyboard.press("Escape")
    assert not page.locator("#help").is_visible()
    for width, height in ((1366, 768), (1024, 768), (820, 1180)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(300)
        assert watched.js("document.documentElement.scrollWidth <= innerWidth"), f"{width} × {height}"
        out = watched.js(
            "[...document.querySelectorAll('button, select, input, csas-slider')].filter(e => e.offsetParent && (r => r.right > innerWidth + 1"
            " || r.left < -1 || r.width < 8)(e.getBoundingClientRect())).map(e => e.id || e.tagName)"
        )
        assert out == [], f"{width} × {height}"
        if (width, height) == (1366, 768):
            assert watched.js("document.documentElement.scrollHeight <= innerHeight")
    watched.settle()
    picture(watched, "tablet")


def test_a_server_that_goes_and_comes_back_is_found_again_without_a_reload(watched, serve):
    store = store_of(range(10))
    server = ViewerServer(store)
    server.start()
    watched.open(server.url)
    watched.js("window.mark = 1")
    end_of(server, watched)
    watched.said.clear()
    again = store_of(range(40))
    serve(again, port=server.port)
    watched.until("csas.views('shadow').length === 40")
    assert watched.js("window.mark") == 1
    forgive_the_pause(watched)


def test_the_state_is_json_that_anybody_can_read(watched, serve, run_store):
    watched.open(serve(run_store))
    from urllib.parse import unquote

    state = json.loads(unquote(watched.js("csas.link()"))[1:])
    assert state["layers"] == ["sub_aperture", "shadow"]
