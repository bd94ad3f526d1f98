# What is asked of the page is JavaScript, and stays in one piece.
# ruff: noqa: E501
"""The operator's work: contacts, judging, rulers, picking, comparing."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from browser import Watched

from csas_shadow_ros.viewer.compare import Second
from csas_shadow_ros.viewer.export import export_html
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import ViewStore

WEB = Path(__file__).resolve().parents[2] / "viewer_web"
STATIC = WEB.parent / "csas_shadow_ros" / "viewer" / "static"


def read(folder: Path) -> ViewStore:
    store = ViewStore()
    source = PathSource(store, folder)
    source.start()
    assert source.done.wait(120)
    return store


@pytest.fixture
def several(results: Path, tmp_path: Path) -> Path:
    """The finished run, told to hold two contacts more, and a body that was left out."""
    folder = tmp_path / "several"
    shutil.copytree(results, folder)
    report = json.loads((folder / "report.json").read_text())
    grid = dict(np.load(folder / "grid.npz"))
    for number, move in ((2, (0.7, 0.5, 0.0)), (3, (-0.6, -0.7, 0.0))):
        np.savez_compressed(folder / f"object_{number}.npz", **grid | {"origin_m": grid["origin_m"] + move})
        first = report["objects"][0]
        place = [first["position_m"][i] + move[i] for i in range(2)]
        report["objects"].append(
            first
            | {
                "number": number,
                "position_m": place,
                "files": [f"object_{number}.npz", f"object_{number}.stl"],
            }
        )
    report["objects_left_out"] = [{"position_m": [0.2, 0.9], "reason": "a phantom", "strong": True}]
    report["views"] |= {"rejected": 1, "rejected_by_aspect_deg": {"45": "too dark"}}
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def test_a_contact_that_is_chosen_is_gone_to_judged_and_kept(watched, serve, several, tmp_path):
    store = read(several)
    url = serve(store)
    watched.open(url)
    page = watched.page
    watched.until("csas.solid.further.object_3?.[0].geometry.index?.count > 0")
    names = page.locator("#contacts button b").all_inner_texts()
    assert names == ["Contact 1", "Contact 2", "Contact 3", "Left out 1"]
    page.click("[data-contact=object-3]")
    place = watched.js("csas.contact.position_m")
    assert watched.js("csas.state.centre") == pytest.approx(place)
    assert watched.js("csas.solid.controls.target.toArray().slice(0, 2)") == pytest.approx(place)
    assert re.search(r"Length\s+[\d.]+ ± [\d.]+ m", page.locator("#dimensions").inner_text())
    assert "1 rejected" in page.locator("#facts").inner_text()
    assert "a phantom" in page.locator("[data-contact=left-out-1]").inner_text(), "the list itself says why"
    page.click("[data-contact=object-1]")
    watched.until("!document.querySelector('#why-here').hidden")
    page.click("[data-contact=left-out-1]")
    assert not page.locator("#why-here").is_visible(), "there is no surface of it"
    assert "May be an object: a phantom" in page.locator("#facts").inner_text()
    page.click("[data-contact=object-3]")
    page.fill("[name=remark]", "fins at one end")
    page.fill("[name=operator]", "A. Smith")
    page.check("[value=mine-like]")
    watched.until("csas.scene.desk.items['object-3']?.value.verdict === 'mine-like'")
    page.click("#bookmark")
    watched.until("document.querySelectorAll('#bookmarks li').length === 1")
    # Another page judges the same: both are there, on both pages.
    other = Watched(page.context.new_page())
    other.open(url)
    other.page.click("[data-contact=object-3]")
    assert other.page.input_value("[name=remark]") == "fins at one end"
    other.js("csas.desk.seen = { 'object-3': 0 }")  # as if it had begun before the first one was kept
    other.js(
        "csas.desk.drafts.set('object-3', { verdict: 'undecided', remark: 'rock?', operator: 'B' }), csas.desk.keepJudgement()"
    )
    watched.until(
        "document.querySelector('#earlier').textContent.includes('mine-like by A. Smith (fins at one end)')"
    )
    # And both at once, neither waiting for the other.
    for one in (watched, other):
        one.js("void [1, 2, 3, 4, 5].forEach(() => csas.desk.bookmark())")
    for one in (watched, other):
        one.until("document.querySelectorAll('#bookmarks li').length === 11")
    other.page.close()
    # After a restart, and in a saved file, it is all there.
    again = read(several)
    item = again.scene()["desk"]["items"]["object-3"]
    assert (item["value"]["operator"], item["earlier"][0]["value"]["operator"]) == ("B", "A. Smith")
    saved = tmp_path / "saved.html"
    saved.write_bytes(export_html(again, 24))
    watched.open(saved.as_uri())
    watched.page.click("[data-contact=object-3]")
    assert watched.page.input_value("[name=remark]") == "rock?"
    assert watched.page.locator("[name=remark]").is_disabled()


def test_evidence_of_a_run_with_several_contacts_is_shown_and_leaves_the_threshold(watched, serve, several):
    watched.open(serve(read(several)))
    watched.until("csas.solid.further.object_3?.[0].geometry.index?.count > 0 && csas.solid.sides.other.triangles > 0")
    told = "['main', 'other'].map(n => document.querySelector(`#row-${n} output`).textContent)"
    before = watched.js(told)
    watched.page.check("#evidence")
    watched.js("csas.solid.render()")
    assert watched.js("csas.solid.sides.main.points.visible && csas.solid.sides.main.points.geometry.attributes.position.count") > 0
    assert watched.js(told) == before
    for name in ("main", "other"):
        assert watched.page.locator(f"#auto-{name}").is_disabled(), "it is still at the automatic threshold"


def test_side_by_side_the_other_method_claims_no_contact_that_it_did_not_carve(watched, serve, several):
    watched.open(serve(read(several)))
    watched.until("csas.solid.further.object_3?.[0].geometry.index?.count > 0 && csas.solid.sides.other.triangles > 0")
    watched.page.check("#compare")
    watched.js("csas.solid.render()")
    assert watched.js("csas.solid.further.object_3.map(mesh => mesh.visible)") == [True, False]
    assert watched.page.locator("#tag-other").inner_text().endswith(": the target alone")


def test_north_is_seen_where_its_line_lies_on_one_of_the_seabed(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.js("csas.solid.look([0, 0, 0.2], 2), csas.solid.render()")
    seen = watched.js("""(() => {
        const s = csas.solid, line = s.sides.main.axes.children.filter(o => o.isLine).at(-1), p = line.geometry.attributes.position, V = s.camera.position.constructor;
        const copy = document.createElement('canvas'); copy.width = s.canvas.width; copy.height = s.canvas.height;
        const g = copy.getContext('2d'), light = [];
        g.drawImage(s.canvas, 0, 0);
        for (let i = 1; i < 20; i++) {
            const at = new V().fromBufferAttribute(p, 0).lerp(new V().fromBufferAttribute(p, p.count - 1), i / 20).project(s.camera);
            const d = g.getImageData((at.x + 1) / 2 * copy.width - 1.5, (1 - at.y) / 2 * copy.height - 1.5, 3, 3).data;
            light.push(Math.max(...d.filter((_, j) => j % 4 === 1)));
        }
        return light; })()""")
    assert min(seen) > 120, str(seen)  # beside the grid's 40; an edge of the carved volume crosses it


def test_all_that_the_ruler_says_can_be_read(watched, serve, several):
    watched.open(serve(read(several)))
    watched.js("csas.setAspect(90)")
    watched.settle()
    watched.until("csas.loader.lines(csas.contourAddress('', csas.sameStamp('shadow_mask', csas.current)))")
    for width, height in ((1366, 768), (1024, 768), (390, 844)):
        watched.page.set_viewport_size({"width": width, "height": height})
        for ends in ("[0, -0.35], [0, -0.8]", "[0, -0.8], [0, -0.35]", "[1, -0.4], [1, -0.9]"):
            watched.js(f"csas.newRuler({ends}), csas.dirty()")
            watched.drawn()
            cut = watched.js("(e => e.scrollHeight - e.clientHeight)(document.querySelector('#measured'))")
            assert cut <= 1, (width, watched.page.locator("#measured").inner_text())


def test_the_printed_page_names_its_pictures_its_bookmarks_its_rulers_and_its_version(watched, serve, several):
    watched.open(serve(read(several)))
    page = watched.page
    page.click("#bookmark")
    watched.js("csas.newRuler([0, -0.35], [0, -0.8])")
    watched.until("document.querySelectorAll('#bookmarks li').length + document.querySelectorAll('#rulers li').length === 2")
    page.emulate_media(media="print")
    for what in ("#panel-a select", "#panel-b select", "#bookmarks li button >> nth=0", "#rulers li button >> nth=0"):
        assert page.locator(what).is_visible(), what
        assert page.locator(what).evaluate("e => getComputedStyle(e).color") == "rgb(0, 0, 0)"
    for what in ("#keep", "#bookmark", "#section", "#bookmarks .small"):
        assert not page.locator(what).is_visible(), what
    version = json.loads((several / "report.json").read_text())["versions"]["csas_shadow_ros"]
    assert f"csas-shadow {version}" in page.locator("#facts").inner_text()


def test_rulers_belong_to_their_aspect_have_ends_and_refuse_what_is_no_shadow(watched, serve, several):
    watched.open(serve(read(several)))
    watched.js("csas.setAspect(90)")
    watched.settle()
    watched.until(
        "csas.measured({ends: [[0, 0], [0, -0.5]], stamp: csas.current.stamp}) && csas.loader.lines(csas.contourAddress('', csas.sameStamp('shadow_mask', csas.current)))"
    )
    told = "csas.measured({ends: %s, stamp: csas.current.stamp})"
    along = watched.js(told % "[[0, -0.35], [0, -0.8]]")
    assert along["height"] == pytest.approx(along["L"] * np.tan(np.radians(along["psi"])))
    across, back = (
        watched.js(told % ends) for ends in ("[[0, -0.4], [0.5, -0.4]]", "[[0, -0.8], [0, -0.35]]")
    )
    beside = watched.js(told % "[[1, -0.4], [1, -0.9]]")
    for refused, why in ((across, "off the ray"), (back, "180° off the ray"), (beside, "segmented shadow")):
        assert "height" not in refused
        assert why in refused["why"]
    # Two rulers, one taken by its end; another aspect has none of them.
    watched.js("csas.newRuler([0, -0.35], [0, -0.7]), csas.newRuler([0.1, -0.35], [0.1, -0.6]), csas.dirty()")
    watched.drawn()
    x, y = watched.js(
        "(() => { const s = csas.panels[1].slider.picture, b = s.getBoundingClientRect(), k = s.width / csas.panels[1].slider.side, [x, y] = csas.panels[1].onCanvas([0, -0.7]); return [b.left + x / k, b.top + y / k]; })()"
    )
    page = watched.page
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y + 30, steps=3)
    page.mouse.up()
    assert watched.js("csas.rulers[0].ends[1][1]") < -0.72
    assert watched.js("csas.rulers[1].ends[1]") == [0.1, -0.6]
    page.locator("#rulers button", has_text="keep").first.click()
    watched.until("csas.allRulers().filter(r => r.kept).length === 1 && csas.allRulers().length === 2")
    watched.js("csas.setAspect(200)")
    watched.drawn()
    assert watched.js("csas.rulersHere().length") == 0
    page.locator("#rulers button").first.click()
    watched.until("csas.current.aspect_deg === 90")


@pytest.mark.long
def test_a_point_of_the_shape_is_its_shadow_in_the_picture_and_a_point_of_the_picture_its_line(
    watched, serve, run_store
):
    watched.open(serve(run_store))
    watched.until("csas.solid.sides.main.triangles > 0")
    watched.js("csas.setAspect(135), csas.desk.goTo3d(), csas.solid.render()")
    watched.settle()
    box = watched.page.locator("#gl").bounding_box()
    at = watched.js(
        "(() => { const V = csas.solid.camera.position.constructor, c = csas.place.centre, p = new V(c[0], c[1], 0.15).project(csas.solid.camera); return [(p.x + 1) / 2, (1 - p.y) / 2]; })()"
    )
    watched.page.mouse.click(box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"])
    point = np.array(watched.js("csas.pick.point"))
    stamp = int(watched.js("csas.current.stamp"))
    sonar = np.array(watched.js("csas.current.sonar"))
    shadow = sonar + (point - sonar) * sonar[2] / (sonar[2] - point[2])
    assert watched.js("csas.pickedGround(csas.current)") == pytest.approx(shadow[:2], abs=0.02)
    assert run_store.entry("shadow", stamp) is not None
    line = np.array(
        watched.js("Array.from(csas.solid.sides.main.picked.geometry.attributes.position.array)")
    ).reshape(-1, 3)
    assert line[0] == pytest.approx(sonar, rel=1e-5)
    assert line[-1][:2] == pytest.approx(shadow[:2], abs=0.02)
    watched.js("csas.pickGround([0.3, -0.4])")
    line = np.array(
        watched.js("Array.from(csas.solid.sides.main.picked.geometry.attributes.position.array)")
    ).reshape(-1, 3)
    assert line[-1] == pytest.approx([0.3, -0.4, 0.0], abs=1e-6)


def test_two_runs_are_compared(watched, serve, results, several):
    report = json.loads((several / "report.json").read_text())
    d = report["dimensions"]
    d["length_m"] += 1.0
    d["position_m"] = [d["position_m"][0] + 0.5, d["position_m"][1]]
    (several / "report.json").write_text(json.dumps(report))
    store = read(results)
    second = Second(store, several)
    second.start()
    assert second.done.wait(60)
    watched.open(serve(store))
    watched.until("csas.solid.further.b?.[0].geometry.index?.count > 0")
    assert watched.js("csas.panels.map(p => p.layer)") == ["shadow", "b.shadow"]
    watched.js("csas.setAspect(45)")
    watched.settle()
    assert watched.js("csas.panels.map(p => p.found.view.aspect_deg)") == [45, 45]
    assert watched.js("csas.solid.further.b[0].position.x") == pytest.approx(-0.5)
    rows = dict(
        line.split("\t", 1)
        for line in watched.page.locator("#dimensions").inner_text().splitlines()
        if "\t" in line
    )
    assert "+1.00 m" in rows["Length"]
    assert watched.js("[...document.querySelectorAll('#dimensions .differs')].map(e => e.textContent)") == [
        "+1.00 m"
    ]
    assert "moved by 0.50 m" in watched.page.locator("#facts").inner_text()


@pytest.mark.long
def test_six_views_evidence_section_overlay_and_the_way_back_to_the_automatic_threshold(
    watched, serve, run_store
):
    watched.open(serve(run_store))
    watched.until("csas.solid.sides.main.triangles > 0 && csas.solid.sides.other.triangles > 0")
    page = watched.page
    page.keyboard.press("8")
    watched.until(
        "csas.panels[1].sixWanted?.length === 6 && csas.panels[1].sixWanted.every(a => csas.loader.bitmap(a))"
    )
    watched.drawn()
    cells = watched.js(
        "(() => { const c = csas.panels[1].slider.picture, g = c.getContext('2d'), w = c.width / 3; return [0, 1, 2].flatMap(x => [0.31, 0.69].map(y => new Set(g.getImageData(w * x + w / 3, c.height * y, w / 3, 9).data).size)); })()"
    )
    assert all(n > 8 for n in cells), cells
    page.keyboard.press("2")
    assert watched.js("csas.evidence.heights.length") > 50
    watched.js("csas.setAspect(csas.evidence.heights[5][0])")
    watched.drawn()
    assert re.match(r"height [\d.]+ m, \d+ % unexplained", page.locator("#measured").inner_text())
    page.check("#overlay")
    page.select_option("#section", "z")
    watched.js("csas.solid.render()")
    assert (
        watched.js(
            "csas.solid.sides.main.over.visible && csas.solid.sides.main.mesh.material.clippingPlanes.length"
        )
        == 1
    )
    before = watched.js("+document.querySelector('#threshold-main').value")
    page.keyboard.press("t")
    page.keyboard.press("Home")
    assert page.locator("#row-main output").inner_text() == "hard carving"
    page.click("#auto-main")
    assert watched.js("+document.querySelector('#threshold-main').value") == before
    assert "main" not in watched.js("Object.keys(csas.state.thresholds)")
    assert page.locator("#why-here").is_visible()
    texts = page.locator("#legend li").all_inner_texts()
    assert {"segmented shadow", "shadow of the mesh", "rejected", "truth", "track"} <= set(texts)
    assert page.locator("#panel-b .low").inner_text() == "-20 dB"


@pytest.mark.long
def test_the_newest_view_is_followed_until_the_circle_is_turned(watched, serve):
    from synthetic import entry

    store = ViewStore(title="live", live=True)
    store.put_view("shadow", entry(0))
    watched.open(serve(store))
    watched.page.check("#follow")
    for i in range(1, 20):
        store.put_view("shadow", entry(i))
    watched.until("Math.abs(csas.state.aspect - 76) < 1e-6")
    watched.page.keyboard.press("ArrowLeft")
    store.put_view("shadow", entry(40))
    watched.until("csas.views('shadow').length === 21")
    watched.drawn()
    assert watched.js("csas.state.aspect") == pytest.approx(72)
    assert not watched.page.is_checked("#follow")


def test_the_page_is_built_of_its_sources(tmp_path):
    esbuild = WEB / "node_modules" / ".bin" / "esbuild"
    if not esbuild.exists():
        pytest.skip("no esbuild: cd viewer_web && npm ci")
    command = json.loads((WEB / "package.json").read_text())["scripts"]["build"]
    command = command.replace("esbuild", str(esbuild)).replace(
        "../csas_shadow_ros/viewer/static", str(tmp_path)
    )
    subprocess.run(command, shell=True, cwd=WEB, check=True, capture_output=True)
    for name in ("app.js", "worker.js"):
        assert (tmp_path / name).read_bytes() == (STATIC / name).read_bytes(), f"{name}: npm run build"
