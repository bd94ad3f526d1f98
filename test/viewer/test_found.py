# What is asked of the page is JavaScript, and stays in one piece.
# ruff: noqa: E501
"""What a new operator ran into: each line has its test in the browser."""

from __future__ import annotations

import json
import math
import re
import shutil
import threading
import urllib.error
import urllib.request
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from browser import Watched
from synthetic import COUNT, entry

from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import ViewStore


def get(url: str, **headers: str) -> tuple[int, bytes, str]:
    sent = {k.replace("_", "-"): v for k, v in headers.items()}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=sent), timeout=30) as answer:
            return answer.status, answer.read(), answer.headers.get("Content-Disposition", "")
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read(), ""


def badge(watched: Any) -> str:
    return watched.page.locator("#link").inner_text()


# 1


def test_a_page_that_came_while_one_set_was_there_shows_the_other_as_soon_as_it_comes(watched, serve):
    store = ViewStore(title="early", live=True)
    for i in range(0, COUNT, 3):
        store.put_view("sub_aperture", entry(i))
    watched.open(serve(store))
    assert watched.js("csas.panels.map(p => p.layer)") == ["sub_aperture", "sub_aperture"]
    for i in range(0, COUNT, 3):
        store.put_view("shadow", entry(i))
    watched.until("csas.panels[1].layer === 'shadow'")
    assert watched.js("csas.panels.map(p => p.select.value)") == ["sub_aperture", "shadow"]
    watched.settle()


@pytest.mark.long
def test_a_picture_that_was_chosen_by_hand_stays(watched, serve):
    store = ViewStore(title="early", live=True)
    for i in range(0, COUNT, 3):
        store.put_view("likelihood", entry(i))
    watched.open(serve(store))
    watched.page.select_option("#panel-b select", "likelihood")
    store.put_view("shadow", entry(0))
    watched.until("csas.views('shadow').length === 1")
    assert watched.js("csas.panels[1].layer") == "likelihood"


# 2


def test_the_badge_says_how_far_the_run_is_and_that_the_graph_is_gone(watched, serve):
    store = ViewStore(title="live", live=True)
    for i in range(36):
        store.put_view("shadow", entry(i))
    progress = {"state": "running", "views": 36, "of": 90, "rate": 12.5, "newest_s": 1, "silent_s": None}
    store.put_part("progress", progress)
    watched.open(serve(store))
    assert badge(watched) == "live: 36 of 90 views at 12.5 /s, newest 1 s ago"
    assert watched.js("document.querySelector('#link').classList.contains('on')")
    store.put_part("progress", progress | {"state": "silent", "silent_s": 8, "newest_s": 8})
    watched.until("document.querySelector('#link').textContent.includes('silent for 8 s')")
    assert not watched.js("document.querySelector('#link').classList.contains('on')")
    assert "36 of 90" in badge(watched)


@pytest.mark.parametrize("live", [False, True])
def test_what_changes_by_itself_moves_no_button(watched, serve, live):
    store = ViewStore(title="a run of the eastern approach", live=live)
    for i in range(36):
        store.put_view("shadow", entry(i))
    watched.open(serve(store))
    where = "['#play', '#orientation', '#help-open', '#panel-a'].map(q => { const b = document.querySelector(q).getBoundingClientRect(); return [b.x, b.y]; })"
    at, told = watched.js(where), set()
    progress = {"views": 1036, "of": 2090, "rate": 12.5, "newest_s": 61, "silent_s": 61}
    for state in ("loading", "running", "silent", "waiting", "finished"):
        watched.js(
            f"csas.notice({{type: 'part', part: 'progress', value: {json.dumps(progress | {'state': state})}}})"
        )
        watched.drawn()
        told.add(badge(watched))
        assert watched.js(where) == at, state
    assert len(told) == (5 if live else 2)


def test_an_object_that_is_drawn_is_not_said_to_be_missing(watched, serve, run_store):
    store = ViewStore(title="restarted", live=True)
    store.put_view("shadow", entry(0))
    store.put_grid("main", run_store.grids["main"])
    store.put_part("status", "1 views, running")
    watched.open(serve(store))
    watched.until(
        "csas.solid.sides.main.triangles > 0 && document.querySelector('#dimensions').innerText.includes('surface here')"
    )
    assert "nothing carved" not in watched.page.locator("#finding").inner_text()


# 3


@pytest.mark.parametrize(
    "share", [pytest.param(0.0, marks=pytest.mark.long), pytest.param(0.5, marks=pytest.mark.long), 0.97]
)
def test_a_grid_that_was_cut_short_is_named_on_the_page_and_no_page_is_saved(
    results, tmp_path, capsys, share
):
    folder = tmp_path / "cut"
    shutil.copytree(results, folder)
    grid = folder / "grid.npz"
    grid.write_bytes(grid.read_bytes()[: int(share * grid.stat().st_size)])
    store = ViewStore()
    source = PathSource(store, folder)
    source.start()
    assert source.done.wait(60)
    assert "grid.npz cannot be read" in store.scene()["damage"]
    assert store.scene()["pictures"], "what is whole is shown"
    page = tmp_path / "page.html"
    assert main(["view", str(folder), "--html", str(page), "--every", "36"]) == 1
    error = capsys.readouterr().err
    assert "grid.npz cannot be read" in error
    assert "Traceback" not in error
    assert not page.exists()


def test_a_report_that_is_broken_is_named_on_the_page_and_in_the_saved_file(results, tmp_path, capsys):
    folder, page = tmp_path / "broken", tmp_path / "page.html"
    shutil.copytree(results, folder)
    (folder / "report.json").write_text('{"format": "csas_shadow_ros results 1", "obj')
    assert main(["view", str(folder), "--html", str(page), "--every", "36"]) == 3
    assert "report.json" in capsys.readouterr().err
    assert "holds no report.json" in page.read_text(encoding="utf-8")


def test_a_file_that_is_saved_while_views_are_loading_waits_for_them(serve):
    store = ViewStore(title="loading")
    store.put_view("shadow", entry(0))
    url, got = serve(store), []
    thread = threading.Thread(target=lambda: got.append(get(f"{url}api/export.html?step=1")[1]))
    thread.start()
    for i in range(1, 20):
        store.put_view("shadow", entry(i))
    thread.join(0.5)
    assert thread.is_alive(), "not before all is there"
    store.loaded.set()
    thread.join(30)
    assert got[0].count(b"api/view/shadow/") == 20


# 4


def test_a_link_brings_rulers_and_the_camera_back(watched, serve, run_store):
    watched.open(serve(run_store))
    watched.js("csas.setAspect(90)")
    watched.settle()
    watched.js(
        "csas.newRuler([0.1, 0.2], [0.1, -0.9]), csas.solid.lookFrom([3, 2, 1, 0.1, 0.2, 0.3]), csas.save()"
    )
    watched.page.keyboard.press("l")
    watched.until("decodeURIComponent(location.hash).includes('camera')")
    link = watched.page.url
    watched.page.goto("about:blank")
    watched.open(link)
    assert watched.js("csas.rulersHere().map(r => r.ends)") == [[[0.1, 0.2], [0.1, -0.9]]]
    assert watched.js("csas.solid.seenFrom()") == pytest.approx([3, 2, 1, 0.1, 0.2, 0.3], abs=1e-3)


def test_a_target_that_comes_late_leaves_the_camera_of_a_link(watched, serve):
    store = ViewStore(title="late")
    for i in range(3):
        store.put_view("shadow", entry(i))
    watched.open(f"{serve(store)}#" + quote(json.dumps({"camera": [3, 2, 1, 0.1, 0.2, 0.3]})))
    watched.until("csas.solid?.renderer")
    watched.js("csas.notice({type: 'part', part: 'target', value: {centre: [1, 1], size: [1, 1, 1]}})")
    assert watched.js("csas.solid.seenFrom()") == pytest.approx([3, 2, 1, 0.1, 0.2, 0.3], abs=1e-3)


# 5


def cursor(watched: Any) -> tuple[float, float]:
    """Where the green cursor is on the circle: degrees on the screen, counter-clockwise from the right."""
    return watched.js(
        """(() => { const s = csas.panels[1].slider, c = s.ring.getBoundingClientRect(), d = s.dot.getBoundingClientRect();
        const x = (d.left + d.right - c.left - c.right) / 2, y = (c.top + c.bottom - d.top - d.bottom) / 2;
        if (d.width < 10 || Math.abs(Math.hypot(x, y) - s.radius) > 1) throw new Error(`no cursor on the circle: ${d.width} px, ${Math.hypot(x, y)} off`);
        return Math.atan2(y, x) * 180 / Math.PI; })()"""
    )


def test_north_up_has_true_north_up(watched, serve):
    store = ViewStore(title="turned")
    for i in range(COUNT):
        store.put_view("shadow", entry(i))
    store.put_part(
        "report", {"verdict": "object", "quality": None, "heights": [], "rejected": [], "north_deg": 30.0}
    )
    d = {"length_m": 1.0, "width_m": 0.5, "height_m": 0.4, "volume_m3": 0.1, "heading_rad": math.radians(120)}
    one = {
        "id": "object-1",
        "name": "Contact 1",
        "kind": "object",
        "position_m": [0, 0],
        "size_m": 1,
        "height_m": 0.4,
    }
    store.put_part("contacts", [one | {"dimensions": d, "volume": "main", "geographic": None}])
    watched.open(serve(store))
    watched.settle()
    # North lies 30° counter-clockwise of the scene's +y: there the picture is turned back to, with its ring.
    up = watched.js(
        "(() => { const p = csas.panels[1], o = p.onCanvas([0, 0]), [x, y] = p.onCanvas([-Math.sin(Math.PI / 6), Math.cos(Math.PI / 6)]); return [x - o[0], y - o[1]]; })()"
    )
    assert up[0] == pytest.approx(0, abs=1e-6)
    assert up[1] < -1
    watched.js("csas.setAspect(120)")
    watched.settle()
    assert cursor(watched) == pytest.approx(90, abs=1)
    assert "sonar bears 000.0°" in watched.page.locator("#where").inner_text()
    # What heads for 120° in the scene lies along true north.
    row = watched.page.locator("#dimensions tr", has_text="Axis bears").inner_text()
    assert "000.0 °" in row


def test_sonar_up_turns_the_circle_with_the_picture(watched, serve):
    store = ViewStore(title="ring")
    for i in range(COUNT):
        store.put_view("shadow", entry(i))
    watched.open(serve(store))
    watched.js("csas.setAspect(60)")
    watched.settle()
    assert cursor(watched) == pytest.approx(60, abs=1)
    watched.page.keyboard.press("n")
    watched.drawn()
    assert cursor(watched) == pytest.approx(90, abs=1), "the sonar is up"
    # The circle is taken hold of and turned by 30° clockwise: what was there is 30° further round.
    x, y, side, radius = watched.js(
        "(() => { const s = csas.panels[1].slider, b = s.ring.getBoundingClientRect(); return [b.left, b.top, s.side, s.radius]; })()"
    )

    def point(a):
        return (
            x + side / 2 + radius * math.cos(math.radians(a)),
            y + side / 2 - radius * math.sin(math.radians(a)),
        )

    watched.page.mouse.move(*point(90))
    watched.page.mouse.down()
    for a in range(88, 59, -4):
        watched.page.mouse.move(*point(a))
    watched.page.mouse.move(*point(60))
    watched.page.mouse.up()
    watched.settle()
    assert watched.js("csas.state.aspect") == pytest.approx(90, abs=4)
    assert cursor(watched) == pytest.approx(90, abs=1)


@pytest.mark.long
def test_the_track_is_seen_whole_and_no_line_of_the_seabed_is_long(watched, serve, run_store):
    watched.open(serve(run_store))
    for size in ({"width": 1366, "height": 768}, {"width": 1024, "height": 768}):
        watched.page.set_viewport_size(size)
        watched.page.wait_for_timeout(200)
        watched.js("csas.solid.whole(true), csas.solid.render()")
        seen = np.array(
            watched.js(
                "(() => { const c = csas.solid.camera, p = csas.solid.sides.main.track.geometry.attributes.position, V = c.position.constructor; return Array.from({ length: p.count }, (_, i) => new V().fromBufferAttribute(p, i).project(c).toArray()); })()"
            )
        )
        assert np.abs(seen[:, :2]).max() < 1.0
        assert np.abs(seen[:, :2]).max() > 0.5, "and fills the view"
    longest = watched.js(
        "(() => { let far = 0; const s = csas.solid.sides.main.scene; s.traverse(o => { const p = o.isLineSegments && o.parent.parent === s && o.geometry.attributes.position; for (let i = 0; p && i < p.count; i += 2) far = Math.max(far, Math.hypot(p.getX(i) - p.getX(i + 1), p.getY(i) - p.getY(i + 1))); }); return far; })()"
    )
    assert 0 < longest <= 0.5 + 1e-6


# 6


def test_an_empty_picture_says_what_it_waits_for(watched, serve):
    store = ViewStore(title="live", live=True)
    watched.page.goto(serve(store))
    empty = "document.querySelectorAll('.empty')[1].textContent"
    watched.until(f"{empty} === 'waiting for a graph: none is heard'")
    store.put_part(
        "progress",
        {"state": "running", "views": 0, "of": 72, "rate": None, "newest_s": None, "silent_s": None},
    )
    watched.until(f"{empty} === 'waiting for shadow-enhanced: 0 of 72 views have come'")
    for i in range(COUNT):
        store.put_view("shadow", entry(i))
    watched.until(f"{empty} === ''")


def test_what_there_is_nothing_to_make_of_is_not_offered(watched, serve, run_store):
    live = ViewStore(title="live", live=True)
    watched.page.goto(serve(live))
    watched.until("window.csas && csas.scene.instance")
    watched.drawn()
    for button in ("#report", "#save-circle", "#save-picture"):
        assert watched.page.locator(button).is_disabled(), button
    live.put_view("shadow", next(iter(run_store.sets["shadow"].values())))
    watched.until("!document.querySelector('#save-picture').disabled")
    assert watched.page.locator("#report").is_disabled()
    watched.open(serve(run_store))
    watched.drawn()
    for button in ("#report", "#save-circle", "#save-picture"):
        assert watched.page.locator(button).is_enabled(), button


@pytest.mark.long
def test_a_finished_run_says_what_it_does_not_hold(watched, serve):
    store = ViewStore(title="one")
    store.put_view("shadow", entry(0))
    store.put_part("progress", {"state": "done"})
    watched.open(serve(store))
    watched.page.keyboard.press("5")
    watched.until("document.querySelectorAll('.empty')[1].textContent === 'this run holds no multi-look'")


# 7


@pytest.mark.parametrize(
    ("width", "height"),
    [
        (60, 600),
        pytest.param(1024, 768, marks=pytest.mark.long),
        pytest.param(320, 240, marks=pytest.mark.long),
    ],
)
def test_no_window_is_too_small_for_the_console_to_stay_clean(watched, serve, width, height):
    store = ViewStore(title="small")
    watched.page.set_viewport_size({"width": width, "height": height})
    watched.page.goto(serve(store))
    watched.until("window.csas")
    store.put_view("shadow", entry(0))
    watched.until("csas.views('shadow').length === 1")
    watched.page.wait_for_timeout(200)
    assert watched.said == []


@pytest.mark.parametrize("step", ["%C2%B2", "%D9%A3", "1e1", "-1", "0", "361", "9" * 5000, ""])
def test_a_step_that_is_no_number_is_refused_by_name(serve, step):
    store = ViewStore()
    store.loaded.set()
    status, body, _ = get(f"{serve(store)}api/export.html?step={step}")
    assert (status, b"step is" in body) == (400, True)


@pytest.mark.parametrize("token", ["x", "short"])
def test_a_token_that_can_be_guessed_is_refused(token, results):
    with pytest.raises(ParameterError, match=r"token has .* expected 12 or more"):
        ViewerServer(ViewStore(), token=token)
    assert main(["view", str(results), "--token", token, "--no-browser", "-q"]) == 1


def test_a_page_elsewhere_starts_no_work(serve):
    url = serve(ViewStore())
    for path in ("api/export.html", "api/reduced", "api/report.pdf", "api/circle.gif", "api/scene", ""):
        assert get(url + path, Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="image")[0] == 403
        assert get(url + path, Sec_Fetch_Site="same-site")[0] == 403
    assert get(url, Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="document")[0] == 200, "a link leads here"
    assert get(f"{url}api/scene", Sec_Fetch_Site="same-origin")[0] == 200


# 8


def test_what_is_saved_has_the_name_of_the_run_and_a_size_of_its_own(watched, serve, run_store, tmp_path):
    from PIL import Image

    url = serve(run_store)
    watched.open(url)
    watched.settle()
    with watched.page.expect_download() as taken:
        watched.page.keyboard.press("s")
    assert taken.value.suggested_filename.startswith("run_shadow_")
    taken.value.save_as(tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as saved:
        assert min(saved.size) >= 1600
        assert len(set(np.asarray(saved.convert("L"))[800, 400:1200].tolist())) > 50, "the picture is in it"
    for path in ("api/mesh/main.stl", "api/export.html?step=36"):
        assert 'filename="run_' in get(url + path)[2]


# 9


def test_a_finger_scrolls_past_the_pictures_and_what_is_touched_is_large_enough(browser, serve, run_store):
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    watched = Watched(context.new_page())
    page = watched.page
    page.goto(serve(run_store))
    watched.until("window.csas && csas.stats.first > 0")
    box = page.locator("#panel-a csas-slider").bounding_box()
    touch = context.new_cdp_session(page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
    for step in range(1, 16):
        touch.send(
            "Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{"x": x, "y": y - 20 * step}]}
        )
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    watched.until("scrollY > 100")
    small = page.evaluate(
        "[...document.querySelectorAll('button, select, input:not([type=range])')].filter(e => e.offsetParent).map(e => [e.id || e.name, e.getBoundingClientRect()]).filter(([, r]) => r.width < 24 || r.height < 24).map(([n]) => n)"
    )
    assert small == []
    context.close()


def luminance(colour: str) -> float:
    parts = [int(v) / 255 for v in re.findall(r"\d+", colour)[:3]]
    r, g, b = (v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@pytest.mark.long
def test_borders_stand_out_text_grows_with_the_screen_and_headings_are_there(watched, serve, run_store):
    watched.open(serve(run_store))
    for name in ("#play", "#panel-a select", "textarea"):
        border, behind = watched.js(
            f"(e => [getComputedStyle(e).borderTopColor, getComputedStyle(e.closest('header, section')).backgroundColor])(document.querySelector('{name}'))"
        )
        light, dark = sorted((luminance(border), luminance(behind)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 3.0, name
    assert watched.js("document.querySelectorAll('h1').length") == 1
    assert watched.js("[...document.querySelectorAll('th')].filter(e => !e.textContent.trim()).length") == 0
    watched.page.set_viewport_size({"width": 3840, "height": 2160})
    watched.page.wait_for_timeout(200)
    assert watched.js("parseFloat(getComputedStyle(document.querySelector('#dimensions')).fontSize)") >= 20


# 10


@pytest.mark.long
def test_a_replay_can_be_watched_and_its_page_goes_on_with_the_results(watched, tiny_box_bag, tmp_path):
    pytest.importorskip("rclpy")
    import signal
    import subprocess
    import sys

    given = [
        str(tiny_box_bag.path),
        "--out",
        str(tmp_path / "out"),
        "--step-deg",
        "10",
        "--no-figures",
        "--view",
    ]
    command = [
        sys.executable,
        "-m",
        "csas_shadow_ros.cli",
        "replay",
        *given,
        "--no-browser",
        "--voxel-size-m",
        "0.04",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    try:
        url = next(m[0] for line in process.stderr if (m := re.search(r"http://\S+", line)))
        for _ in range(600):
            try:
                watched.page.goto(url)
                break
            except Exception:
                watched.page.wait_for_timeout(100)
        watched.until("window.csas && csas.views('shadow').length > 3", 60)
        assert watched.js("csas.scene.live")
        for width, height in ((1920, 1080), (3840, 2160), (1024, 768), (390, 844)):
            watched.page.set_viewport_size({"width": width, "height": height})
            watched.drawn()
            assert watched.js("document.documentElement.scrollWidth <= innerWidth")
        watched.until(
            "!csas.scene.live && csas.views('shadow').length === 36 && csas.scene.contacts.length", 90
        )
    finally:
        watched.page.goto("about:blank")  # it would ask for a server that has ended, and say so late
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        process.stderr.close()
    assert json.loads((tmp_path / "out" / "report.json").read_text())["through"] == "node graph"
    watched.said[:] = [s for s in watched.said if "WebSocket" not in s and "ERR_" not in s]
