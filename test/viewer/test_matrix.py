# What is asked of the page is JavaScript, and stays in one piece.
# ruff: noqa: E501
"""Every line of the operator's desk, on a real run with three objects, on every screen.

One screen and a small run in `make test`; all of them, with a run of full size, by `make long`.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from browser import Watched
from test_found import cursor, get, luminance

from csas_shadow_ros.cli import main
from csas_shadow_ros.core.imaging.mask_codes import MASK_SHADOW
from csas_shadow_ros.viewer.compare import Second
from csas_shadow_ros.viewer.contact_report import sheet_of, view_of_shadow
from csas_shadow_ros.viewer.crop import contact_named, shadow_m
from csas_shadow_ros.viewer.desk import FILE, Desk
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import ViewStore

#: Where pictures of the full run on a laptop go: those of docs/viewer.md (CSAS_SCREENSHOTS=docs/figures).
SCREENSHOTS = os.environ.get("CSAS_SCREENSHOTS", "")
SCREENS = ((1366, 768), (1920, 1080), (3840, 2160), (1024, 768), (390, 844))


def three_boxes(place: Path, scale: float, *simulated: str) -> Path:
    """Simulate three boxes of which none shadows another from all sides, and run the method on them."""
    bodies = []
    for x, y, size, turn in (
        (0, 0, (0.8, 0.4, 0.4), 0.35),
        (1.2, 0.8, (0.5, 0.4, 0.4), -0.5),
        (-1.1, -0.9, (0.5, 0.35, 0.4), 1.2),
    ):
        body = trimesh.creation.box(size)
        body.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        body.apply_translation((x, y, size[2] / 2))
        body.apply_scale(scale)
        bodies.append(body)
    trimesh.util.concatenate(bodies).export(place / "three.stl")
    bag = str(place / "bag")
    assert main(["simulate", bag, "--target", str(place / "three.stl"), "-q", *simulated]) == 0
    given = ["--out", str(place / "run"), "--voxel-size-m", "0.03", "--no-figures", "-q"]
    assert main(["run", bag, *given, "--step-deg", "10" if simulated else "5"]) == 0
    return place / "run"


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three objects in a scene of 2.5 m: ten seconds."""
    return three_boxes(tmp_path_factory.mktemp("small"), 0.62, "--profile", "tiny")


@pytest.fixture(scope="session")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three objects at full size: a minute."""
    return three_boxes(tmp_path_factory.mktemp("three"), 1.0)


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """axe-core, from npm: a tool of the tests alone, under a licence of its own (MPL)."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm to get axe-core with")
    place = tmp_path_factory.mktemp("axe")
    got = subprocess.run(
        [npm, "install", "--prefix", str(place), "axe-core@4.10.3"], capture_output=True, text=True
    )
    if got.returncode:
        pytest.skip(f"npm cannot get axe-core: {got.stderr.strip().splitlines()[-1][:200]}")
    return (place / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


def read(folder: Path) -> ViewStore:
    store = ViewStore()
    source = PathSource(store, folder)
    source.start()
    assert source.done.wait(120)
    return store


@dataclass
class Desktop:
    """A page on a screen, the run that it shows, and what opens others."""

    w: Watched
    serve: Callable[..., str]
    folder: Path
    store: ViewStore
    url: str
    tmp: Path
    width: int
    height: int

    @property
    def page(self) -> Any:
        return self.w.page

    def js(self, text: str) -> Any:
        return self.w.js(text)

    def live(self) -> ViewStore:
        """Return a store as of a graph that has sent nothing yet; the run's views can be put into it."""
        return ViewStore(title="live", live=True)

    def views(self, name: str) -> list[Any]:
        return list(self.store.sets[name].values())

    def again(self) -> None:
        """Open the page anew, as whoever comes to it."""
        self.page.goto("about:blank")
        self.w.open(self.url)
        self.w.settle()
        self.w.until("csas.solid.sides.main.triangles > 0")

    def picture(self, name: str, **how: Any) -> None:
        if SCREENSHOTS and self.width == SCREENS[0][0] and len(self.views("shadow")) == 72:
            self.w.settle()
            self.page.screenshot(path=str(Path(SCREENSHOTS) / f"viewer_{name}.png"), **how)

    def taken(self, button: str) -> Any:
        with self.page.expect_download() as download:
            self.page.click(button)
        return download.value


# -- the decision -----------------------------------------------------------------------------------


def contacts_are_listed_and_gone_to(d: Desktop) -> None:
    assert [n[:7] for n in d.page.locator("#contacts button b").all_inner_texts()] == ["Contact"] * 3
    d.w.until("csas.solid.further.object_3?.[0].geometry.index?.count > 0")
    lengths = {c["id"]: (c["dimensions"]["length_m"], c["truth"]["length_m"]) for c in d.store.scene()["contacts"]}
    for contact in ("object-3", "object-2", "object-1"):
        d.page.click(f"[data-contact={contact}]")
        place = d.js("csas.contact.position_m")
        assert d.js("csas.state.centre") == pytest.approx(place)
        assert d.js("csas.solid.controls.target.toArray().slice(0, 2)") == pytest.approx(place)
        found, true = lengths[contact]
        row = d.page.locator("#dimensions tr", has_text="Length").inner_text()
        spread = r"(± [\d.]+|−[\d.]+ \+[\d.]+)"
        assert re.search(rf"{found:.2f} {spread} m\s+{true:.2f} m", row), "the truth is this contact's own"
        sheet = sheet_of(d.store, contact)
        assert sheet.rows[0] == ["Length", row.split("\t")[1], f"{true:.2f} m"], "the report too"
        # The report's picture has its whole shadow: no edge of the scene, and no neighbour, cuts it off.
        one = contact_named(d.store, contact)
        _, view = view_of_shadow(d.store, one)
        away = -np.array([math.cos(view.info.aspect_rad), math.sin(view.info.aspect_rad)])
        tip = np.append(np.array(place) + 0.8 * shadow_m(view.info, one) * away, 1.0)
        u, v = np.rint(view.info.camera.ground_to_pixel[:2] @ tip).astype(int)
        assert d.store.entry("shadow_mask", view.info.stamp_ns).load()[v, u] == MASK_SHADOW
    assert "the result is " in d.page.locator("#verdict").inner_text()
    facts = d.page.locator("#facts").inner_text()
    assert re.search(r"Views: \d+ used of \d+", facts)
    assert "Heights by view: median" in facts


def a_judgement_a_bookmark_and_a_ruler_are_kept_and_come_back(d: Desktop) -> None:
    d.page.click("[data-contact=object-2]")
    d.page.fill("[name=remark]", f"seen at {d.width}")
    d.page.fill("[name=operator]", "A. Smith")
    d.page.locator("#judge label", has_text="undecided").click()
    d.w.until("csas.scene.desk.items['object-2']?.value.verdict === 'undecided'")
    d.picture("desk")
    d.page.click("#bookmark")
    d.w.until("document.querySelectorAll('#bookmarks li').length === 1")
    d.js("csas.newRuler([0, -0.2], [0, -0.5])")
    d.page.locator("#rulers button", has_text="keep").click()
    d.w.until("csas.allRulers().some(r => r.kept)")
    d.again()
    d.page.click("[data-contact=object-2]")
    assert d.page.input_value("[name=remark]") == f"seen at {d.width}"
    assert d.page.is_checked("[value=undecided]")
    assert d.page.locator("#bookmarks li").count() == d.page.locator("#rulers li").count() == 1
    assert {i["kind"] for i in Desk(d.folder).document()["items"].values()} == {"judgement", "bookmark", "ruler"}
    d.page.click("[data-contact=object-1]")


def a_report_and_the_circle_are_taken_from_the_page(d: Desktop) -> None:
    report, circle = d.taken("#report"), d.taken("#save-circle")
    for got, name, magic in ((report, "run_object-1.pdf", b"%PDF"), (circle, "run_object-1.gif", b"GIF89a")):
        assert got.suggested_filename == name
        assert Path(got.path()).read_bytes().startswith(magic)


def the_page_and_its_report_are_printed_on_one_sheet(d: Desktop) -> None:
    sheets = re.compile(rb"/Type\s*/Page\b(?!s)")
    assert len(sheets.findall(d.page.pdf(prefer_css_page_size=True, print_background=True))) == 1
    Desk(d.folder).change([{"id": "object-3", "kind": "judgement", "base": 0, "value": {"verdict": "mine-like", "remark": "a word and another " * 105, "operator": "A"}}])
    out = d.tmp / f"report_{d.width}.html"
    assert main(["report", str(d.folder), "--contact", "3", "--out", str(out), "-q"]) == 0
    d.page.goto(out.as_uri())
    assert d.js("document.documentElement.scrollWidth <= innerWidth")
    assert len(sheets.findall(d.page.pdf(prefer_css_page_size=True))) == 1
    d.again()


def two_runs_are_compared_contact_by_contact(d: Desktop) -> None:
    other = d.tmp / f"other_{d.width}"
    shutil.copytree(d.folder, other)
    report = json.loads((other / "report.json").read_text())
    report["objects"][1]["dimensions"]["length_m"] += 1.0
    (other / "report.json").write_text(json.dumps(report))
    store = read(d.folder)
    second = Second(store, other)
    second.start()
    assert second.done.wait(120)
    d.w.open(d.serve(store))
    assert d.js("csas.panels.map(p => p.layer)") == ["shadow", "b.shadow"]
    d.js("csas.setAspect(120)")
    d.w.settle()
    assert d.js("csas.panels.map(p => p.found.view.aspect_deg)") == pytest.approx([120, 120])
    d.w.until("csas.solid.further.b?.[0].geometry.index?.count > 0 && csas.solid.further.b_object_2?.[0].geometry.index?.count > 0")
    assert "\t0.00 m" in d.page.locator("#dimensions tr", has_text="Length").inner_text()
    d.picture("compare")
    d.page.click("[data-contact=object-2]")
    assert "+1.00 m" in d.page.locator("#dimensions .differs").inner_text()
    d.again()


# -- the pictures -----------------------------------------------------------------------------------


def it_opens_at_the_contact_and_the_pictures_use_their_room(d: Desktop) -> None:
    assert d.js("csas.state.zoom") > 1.0
    assert d.js("csas.state.centre") == pytest.approx(d.js("csas.scene.contacts[0].position_m"))
    side = d.js("csas.panels[1].slider.side")
    if d.width > 1100:
        assert d.js("document.documentElement.scrollHeight <= innerHeight")
        assert side > 0.34 * d.width or side > 0.6 * d.height
    else:
        assert side > 0.8 * min(d.width, d.width / (2 if d.width > 640 else 1))
    assert d.js("document.documentElement.scrollWidth <= innerWidth")
    out = d.js("[...document.querySelectorAll('button, select, input, textarea, csas-slider')].filter(e => e.offsetParent && !e.closest('#finding') && (r => r.right > innerWidth + 1 || r.left < -1 || r.width < 8)(e.getBoundingClientRect())).map(e => e.id || e.tagName)")
    assert out == []


def six_views_are_shown_at_once(d: Desktop) -> None:
    d.page.keyboard.press("8")
    d.w.until("csas.panels[1].sixWanted?.length === 6 && csas.panels[1].sixWanted.every(a => csas.loader.bitmap(a))")
    d.w.drawn()
    cells = d.js("(() => { const c = csas.panels[1].slider.picture, g = c.getContext('2d'), w = c.width / 3; return [0, 1, 2].flatMap(x => [0.31, 0.69].map(y => new Set(g.getImageData(w * x + w / 3, c.height * y, w / 3, 9).data).size)); })()")
    assert all(n > 8 for n in cells), cells
    d.page.keyboard.press("2")
    d.w.settle()


def ring_evidence_legend_and_bar_say_what_is_seen(d: Desktop) -> None:
    assert len(d.js("csas.evidence.heights")) > 20
    d.js("csas.setAspect(csas.evidence.heights[5][0])")
    d.w.settle()
    assert re.match(r"height [\d.]+ m, \d+ % unexplained", d.page.locator("#measured").inner_text())
    colours = d.js("[...new Set([...document.querySelectorAll('#legend li')].map(e => getComputedStyle(e, '::before').backgroundColor))].length")
    texts = d.page.locator("#legend li").all_inner_texts()
    assert len(texts) == len(set(texts)) >= 17
    assert colours >= len(texts) - 2, "the track is as the ring, and no other line as another"
    assert d.page.locator("#panel-b .low").inner_text() == "-20 dB"
    assert d.js("document.querySelector('#panel-b .bar').width") == 255


def what_is_picked_in_a_picture_is_a_line_and_on_the_shape_a_shadow(d: Desktop) -> None:
    d.js("csas.setAspect(40), csas.zoomToContact(), csas.desk.goTo3d(), csas.solid.render()")
    d.w.settle()
    d.page.locator("#gl").scroll_into_view_if_needed()
    box = d.page.locator("#gl").bounding_box()
    at = d.js("(() => { const V = csas.solid.camera.position.constructor, c = csas.place, p = new V(...c.centre, c.height / 2).project(csas.solid.camera); return [(p.x + 1) / 2, (1 - p.y) / 2]; })()")
    d.page.mouse.click(box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"])
    point, sonar = np.array(d.js("csas.pick.point")), np.array(d.js("csas.current.sonar"))
    shadow = sonar + (point - sonar) * sonar[2] / (sonar[2] - point[2])
    assert d.js("csas.pickedGround(csas.current)") == pytest.approx(shadow[:2], abs=0.02)
    d.page.locator("#panel-b csas-slider").scroll_into_view_if_needed()
    x, y = d.js("(() => { const s = csas.panels[1].slider.picture, b = s.getBoundingClientRect(), k = s.width / csas.panels[1].slider.side, [x, y] = csas.panels[1].onCanvas([csas.place.centre[0] - 0.1, csas.place.centre[1] - 0.1]); return [b.left + x / k, b.top + y / k]; })()")
    d.page.mouse.click(x, y)
    assert d.js("csas.pick.ground") == pytest.approx(d.js("csas.place.centre.map(v => v - 0.1)"), abs=0.03)
    line = np.array(d.js("Array.from(csas.solid.sides.main.picked.geometry.attributes.position.array)")).reshape(-1, 3)
    assert line[0] == pytest.approx(sonar, rel=1e-5)
    assert line[-1][2] == 0.0
    d.js("csas.pickPoint(null)")


def rulers_have_ends_belong_to_their_aspect_and_refuse_what_is_no_shadow(d: Desktop) -> None:
    d.js("csas.setAspect(90), csas.zoomToContact()")
    d.w.settle()
    d.w.until("csas.loader.lines(csas.contourAddress('', csas.sameStamp('shadow_mask', csas.current)))")
    x, y = d.js("csas.place.centre")
    half = d.js("csas.place.size / 2")
    ends = json.dumps([[x, y - 0.8 * half], [x, y - 0.8 * half - 0.3]])
    across = json.dumps([[x, y - half], [x + 0.5, y - half]])
    assert "height" in d.js(f"csas.measured({{ends: {ends}, stamp: csas.current.stamp}})")
    assert "off the ray" in d.js(f"csas.measured({{ends: {across}, stamp: csas.current.stamp}})")["why"]
    there = d.js("csas.rulers.length")
    d.js(f"csas.newRuler(...{ends}), csas.newRuler(...{across}), csas.dirty()")
    d.w.drawn()
    d.page.locator("#panel-b csas-slider").scroll_into_view_if_needed()
    px, py = d.js(f"(() => {{ const s = csas.panels[1].slider.picture, b = s.getBoundingClientRect(), k = s.width / csas.panels[1].slider.side, [x, y] = csas.panels[1].onCanvas({ends}[1]); return [b.left + x / k, b.top + y / k]; }})()")
    d.page.mouse.move(px, py)
    d.page.mouse.down()
    d.page.mouse.move(px, py + 12, steps=3)
    d.page.mouse.up()
    assert d.js(f"csas.rulers[{there}].ends[1][1]") < y - 0.8 * half - 0.3
    assert d.js(f"csas.rulers[{there + 1}].ends[0]") == [x, y - half]
    d.js("csas.setAspect(200)")
    d.w.settle()
    assert d.js(f"csas.rulersHere().filter(r => csas.rulers.slice({there}).includes(r)).length") == 0
    d.js(f"csas.rulers.splice({there}), csas.ruler = null, csas.desk.later()")


def the_shape_has_section_overlays_thresholds_and_ways_back(d: Desktop) -> None:
    d.w.until("csas.solid.sides.main.triangles > 0 && csas.solid.sides.other.triangles > 0")
    d.page.check("#overlay")
    d.page.check("#truth")
    d.page.select_option("#section", "z")
    d.js("csas.solid.render()")
    side = "csas.solid.sides.main"
    assert d.js(f"{side}.over.visible && {side}.truth.visible && {side}.mesh.material.clippingPlanes.length") == 1
    assert d.js(f"{side}.axes.children.filter(o => o.isLine).length") == 4, "x, y, z and north"
    assert d.js(f"{side}.axes.children.filter(o => o.isSprite).length") >= 7, "four names, a number an axis"
    auto = d.js("+document.querySelector('#threshold-main').value")
    d.page.focus("#threshold-main")
    d.page.keyboard.press("Home")
    assert d.page.locator("#row-main output").inner_text() == "hard carving"
    d.page.click("#auto-main")
    assert d.js("+document.querySelector('#threshold-main').value") == auto
    d.w.until("document.querySelector('#dimensions').innerText.includes('surface')")
    assert d.page.locator("#why-here").is_visible()
    d.page.select_option("#section", "off")
    for box in ("#overlay", "#truth"):
        d.page.uncheck(box)


# -- what was found ---------------------------------------------------------------------------------


def an_early_page_a_live_badge_and_the_newest_view(d: Desktop) -> None:
    """Faults 1, 2 and 6, and following the newest view."""
    live = d.live()
    d.page.goto(d.serve(live))
    empty = "document.querySelectorAll('.empty')[1].textContent"
    d.w.until(f"{empty} === 'waiting for a graph: none is heard'")
    assert d.page.locator("#link").inner_text() == "live: waiting for a graph"
    progress = {"state": "running", "views": 0, "of": 36, "rate": None, "newest_s": None, "silent_s": None}
    live.put_part("progress", progress)
    d.w.until(f"{empty} === 'waiting for shadow-enhanced: 0 of 36 views have come'")
    for view in d.views("sub_aperture")[:9]:
        live.put_view("sub_aperture", view)
    d.w.until("csas.panels.every(p => p.layer === 'sub_aperture')")
    d.page.check("#follow")
    for view in d.views("shadow")[:9]:
        live.put_view("shadow", view)
    d.w.until("csas.panels[1].layer === 'shadow'")
    newest = math.degrees(d.views("shadow")[8].info.aspect_rad)
    d.w.until(f"Math.abs(csas.state.aspect - {newest}) < 1e-3")
    live.put_part("progress", progress | {"views": 9, "rate": 4.5, "newest_s": 1})
    d.w.until("document.querySelector('#link').textContent === 'live: 9 of 36 views at 4.5 /s, newest 1 s ago'")
    live.put_part("progress", progress | {"state": "silent", "views": 9, "newest_s": 8, "silent_s": 8})
    d.w.until("document.querySelector('#link').textContent.includes('silent for 8 s')")
    assert not d.js("document.querySelector('#link').classList.contains('on')")
    live.put_grid("main", d.store.grids["main"])
    d.w.until("csas.solid?.sides.main.triangles > 0 && document.querySelector('#dimensions').innerText.includes('surface')")
    assert "nothing carved" not in d.page.locator("#finding").inner_text()
    d.again()


def what_is_damaged_is_said_and_not_saved_as_if_it_were_whole(d: Desktop) -> None:
    cut = d.tmp / f"cut_{d.width}"
    shutil.copytree(d.folder, cut)
    grid = cut / "grid.npz"
    grid.write_bytes(grid.read_bytes()[: grid.stat().st_size // 2])
    (cut / "desk.json").write_text("{")
    store = read(cut)
    d.w.open(d.serve(store))
    for told in ("grid.npz cannot be read", "desk.json cannot be read"):
        assert told in d.page.locator("#damage").inner_text()
        assert told in d.page.locator("#facts").inner_text()
    box = d.page.locator("#damage").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= d.width
    assert d.page.locator("#keep").is_disabled()
    page = cut / "page.html"
    assert main(["view", str(cut), "--html", str(page), "-q"]) == 1
    assert not page.exists()
    d.again()


def a_link_brings_rulers_and_camera(d: Desktop) -> None:
    d.js("csas.setAspect(90)")
    d.w.settle()
    d.js("csas.newRuler([0.1, 0.2], [0.1, -0.9]), csas.solid.lookFrom([3, 2, 1, 0.1, 0.2, 0.3]), csas.save()")
    d.page.click("#copy-link")
    d.w.until("decodeURIComponent(location.hash).includes('camera')")
    link = d.page.url
    d.page.goto("about:blank")
    d.w.open(link)
    assert [[0.1, 0.2], [0.1, -0.9]] in d.js("csas.rulersHere().map(r => r.ends)")
    assert d.js("csas.solid.seenFrom()") == pytest.approx([3, 2, 1, 0.1, 0.2, 0.3], abs=1e-3)
    d.again()


def sonar_up_turns_the_ring_and_the_track_is_seen_whole(d: Desktop) -> None:
    d.js("csas.setAspect(60)")
    d.w.settle()
    assert cursor(d.w) == pytest.approx(60, abs=1)
    d.page.click("#orientation")
    d.w.drawn()
    assert cursor(d.w) == pytest.approx(90, abs=1)
    d.page.click("#orientation")
    d.page.check("#whole")
    d.js("csas.solid.render()")
    seen = np.array(d.js("(() => { const c = csas.solid.camera, p = csas.solid.sides.main.track.geometry.attributes.position, V = c.position.constructor; return Array.from({ length: p.count }, (_, i) => new V().fromBufferAttribute(p, i).project(c).toArray()); })()"))
    assert 0.4 < np.abs(seen[:, :2]).max() < 1.0, "whole, and as large as there is room"
    longest = d.js("(() => { let far = 0; const s = csas.solid.sides.main.scene; s.traverse(o => { const p = o.isLineSegments && o.parent.parent === s && o.geometry.attributes.position; for (let i = 0; p && i < p.count; i += 2) far = Math.max(far, Math.hypot(p.getX(i) - p.getX(i + 1), p.getY(i) - p.getY(i + 1))); }); return far; })()")
    assert 0 < longest <= 0.5 + 1e-6
    d.page.uncheck("#whole")


def no_size_while_loading_and_no_stranger_makes_an_error(d: Desktop) -> None:
    for width, height in ((d.width, d.height), (60, 600)):
        d.page.set_viewport_size({"width": width, "height": height})
        store = ViewStore(title="loading")
        d.page.goto(d.serve(store))
        d.w.until("window.csas")
        store.put_view("shadow", d.views("shadow")[0])
        d.w.until("csas.views('shadow').length === 1")
        d.w.drawn()
    d.page.set_viewport_size({"width": d.width, "height": d.height})
    assert d.w.said == []
    assert get(f"{d.url}api/export.html?step=%C2%B2")[0] == 400
    for path in ("api/export.html", "api/reduced", "api/report.pdf", "api/circle.gif"):
        assert get(d.url + path, Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="image")[0] == 403
    d.again()


def what_is_saved_has_the_runs_name_and_a_size_of_its_own(d: Desktop) -> None:
    from PIL import Image

    got = d.taken("#save-picture")
    assert got.suggested_filename.startswith("run_shadow_")
    with Image.open(got.path()) as saved:
        assert min(saved.size) >= 1600
        assert len(set(np.asarray(saved.convert("L"))[800, 400:1200].tolist())) > 50
    assert d.taken("#save-html").suggested_filename == "run_view.html"


def text_borders_and_headings_can_be_read(d: Desktop) -> None:
    for name in ("#play", "#panel-a select", "textarea"):
        border, behind = d.js(f"(e => [getComputedStyle(e).borderTopColor, getComputedStyle(e.closest('header, section')).backgroundColor])(document.querySelector('{name}'))")
        light, dark = sorted((luminance(border), luminance(behind)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 3.0, name
    assert d.js("document.querySelectorAll('h1').length") == 1
    assert d.js("[...document.querySelectorAll('th')].filter(e => !e.textContent.trim()).length") == 0
    text = d.js("parseFloat(getComputedStyle(document.querySelector('#dimensions')).fontSize)")
    assert text >= max(12, 20 if d.width >= 3840 else 0)
    small = d.js("[...document.querySelectorAll('button, select, input:not([type=range])')].filter(e => e.offsetParent).map(e => [e.id || e.name, e.getBoundingClientRect()]).filter(([, r]) => r.width < 24 || r.height < 24).map(([n]) => n)")
    assert small == []


LINES = (
    it_opens_at_the_contact_and_the_pictures_use_their_room,
    contacts_are_listed_and_gone_to,
    six_views_are_shown_at_once,
    ring_evidence_legend_and_bar_say_what_is_seen,
    what_is_picked_in_a_picture_is_a_line_and_on_the_shape_a_shadow,
    rulers_have_ends_belong_to_their_aspect_and_refuse_what_is_no_shadow,
    the_shape_has_section_overlays_thresholds_and_ways_back,
    sonar_up_turns_the_ring_and_the_track_is_seen_whole,
    text_borders_and_headings_can_be_read,
    a_judgement_a_bookmark_and_a_ruler_are_kept_and_come_back,
    a_report_and_the_circle_are_taken_from_the_page,
    what_is_saved_has_the_runs_name_and_a_size_of_its_own,
    a_link_brings_rulers_and_camera,
    an_early_page_a_live_badge_and_the_newest_view,
    no_size_while_loading_and_no_stranger_makes_an_error,
    two_runs_are_compared_contact_by_contact,
    what_is_damaged_is_said_and_not_saved_as_if_it_were_whole,
    the_page_and_its_report_are_printed_on_one_sheet,
)
#: So many of them open no other page, and take a second each. Of the others each has a test of its own, on a
#: laptop's screen, beside this.
OPEN = 9


def desktop(watched: Watched, serve: Any, run: Path, tmp: Path, width: int, height: int) -> Desktop:
    folder = tmp / "run"
    shutil.copytree(run, folder)
    store = read(folder)
    watched.page.set_viewport_size({"width": width, "height": height})
    made = Desktop(watched, serve, folder, store, serve(store), tmp, width, height)
    made.again()
    return made


def goes_through(made: Desktop, lines: tuple[Callable[[Desktop], None], ...]) -> None:
    """Go through lines on one page; each fault is told with its line's name, and the others are tried too."""
    failed = []

    def files() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in made.folder.rglob("*") if p.is_file() and p.name != FILE}

    before = files()
    for line in lines:
        try:
            line(made)
        except Exception as error:
            failed.append(f"{line.__name__}: {str(error)[:1500]}")
            made.again()
    assert failed == []
    assert files() == before, "of all that was done the judgements alone are written"


def test_what_a_page_that_is_open_shows_holds_on_a_laptop(watched, serve, small, tmp_path):
    goes_through(desktop(watched, serve, small, tmp_path, 1366, 768), LINES[:OPEN])


def test_nothing_runs_off_a_phones_screen(watched, serve, small, tmp_path):
    goes_through(desktop(watched, serve, small, tmp_path, 390, 844), LINES[:1])


@pytest.mark.long
@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_every_line_holds_on_every_screen(watched, serve, three, tmp_path, width, height):
    goes_through(desktop(watched, serve, three, tmp_path, width, height), LINES)


def axe_on(made: Desktop, axe: str) -> list[str]:
    """Ask axe of the page as it opens, with all that can be there, of its help and of its report."""
    found = []

    def ask(state: str) -> None:
        made.w.js(axe)  # by the debugger: the page itself takes no script but its own
        found.extend(made.js(f"axe.run().then(r => r.violations.map(v => `{state}: ${{v.id}}: ${{v.nodes.map(n => n.target).join(' ')}}`))"))

    ask("opened")
    made.js("csas.newRuler([0, -0.3], [0, -0.8]), csas.desk.bookmark(), document.querySelector('#compare').click()")
    made.page.select_option("#section", "z")
    made.page.locator("#judge label", has_text="undecided").click()
    made.w.until("document.querySelectorAll('#bookmarks li').length === 1 && document.querySelector('#kept').textContent")
    ask("judged")
    made.page.click("#help-open")
    ask("help")
    made.page.goto(made.serve(made.live()))
    made.w.until("window.csas && csas.scene.instance")
    ask("empty")
    page = made.tmp / "report.html"
    assert main(["report", str(made.folder), "--out", str(page), "-q"]) == 0
    made.page.goto(page.as_uri())
    ask("report")
    return found


def test_axe_finds_nothing_on_a_laptop(watched, serve, small, axe, tmp_path):
    assert axe_on(desktop(watched, serve, small, tmp_path, 1366, 768), axe) == []


@pytest.mark.long
@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_axe_finds_nothing_on_any_screen(watched, serve, three, axe, tmp_path, width, height):
    assert axe_on(desktop(watched, serve, three, tmp_path, width, height), axe) == []
