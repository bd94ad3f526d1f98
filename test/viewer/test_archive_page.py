"""The page of an archive: rows, map, thumbnails, and a click that opens the run."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pyarrow", reason="extra archive is not installed")
pytest.importorskip("duckdb", reason="extra archive is not installed")

import csas_shadow_ros
from csas_shadow_ros.archive.catalogue import rebuild
from csas_shadow_ros.archive.layout import Archive, ArchiveError, PartOfTask, Record
from csas_shadow_ros.archive_page.content import Content
from csas_shadow_ros.archive_page.server import ArchiveServer
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import CsasError, ParameterError

ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]
PLACES = {"alpha": (48.3829, -4.4953), "beta": (48.3831, -4.4950), "gamma": None}
HOSTILE = "<img src=x onerror=alert(1)>'--"


def add(archive: Path, name: str, results: Path | None, place: Any = None, reason: str = "") -> None:
    folder = archive / "runs" / "3f" / f"{name}-{abs(hash(name)):x}"
    folder.mkdir(parents=True)
    if results is not None:
        shutil.copytree(results, folder / "results")
        report = json.loads((folder / "results" / "report.json").read_text())
        latitude, longitude = place or (0.0, 0.0)
        origin = {
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "heading_deg": 0.0,
            "altitude_m": 0.0,
            "covariance_m2": None,
        }
        report["datum"] = origin if place else None
        for entry in report["objects"]:
            entry["place"] = (
                {"latitude_deg": latitude, "longitude_deg": longitude, "bearing_deg": 10.0} if place else None
            )
        (folder / "results" / "report.json").write_text(json.dumps(report))
    Record(f"/bags/{name}", f"{name:0>64}", "s", "o", "1", 1, [PartOfTask(reason=reason)]).write(
        folder, durable=False
    )


@pytest.fixture(scope="module")
def season(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of three runs of one box, two of which have a place, and a bag that failed."""
    root = tmp_path_factory.mktemp("season") / "season"
    Archive(root).make()
    for name, place in PLACES.items():
        add(root, name, results, place)
    add(root, HOSTILE, None, reason="no track, and 100% 'broken'")
    rebuild(root)
    return root


@pytest.fixture
def serve_archive(season: Path) -> Any:
    servers: list[ArchiveServer] = []

    def start(**options: Any) -> ArchiveServer:
        server = ArchiveServer(Content(season), **options)
        server.start()
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.stop()


@pytest.fixture
def serve() -> Any:
    """Of `watched`: the servers here are archives'."""
    return None


def ask(url: str, data: Any = None, **headers: str) -> tuple[int, bytes]:
    body = None if data is None else json.dumps(data).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json", **headers})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_rows_are_those_that_are_asked_for(season: Path) -> None:
    content = Content(season)
    whole = content.answer({})
    assert (whole["title"], whole["count"], len(whole["rows"])) == ("season", 4, 4)
    assert whole["choices"]["status"] == ["done", "failed"]
    assert {tuple(point[:2]) for point in whole["points"]} == {place for place in PLACES.values() if place}

    def names(**asked: str) -> set[str]:
        return {row["name"] for row in content.answer(asked)["rows"]}

    assert names(status="failed") == names(text="BROKEN") == names(text=HOSTILE.upper()) == {HOSTILE}
    assert names(verdict="object") == set(PLACES)
    assert names(least_length_m="0.5", most_length_m="1.2") == set(PLACES)
    assert names(least_height_m="3") == names(text="100_") == names(verdict="' OR ''='") == set()
    assert names(where="place_latitude_deg > 48.383") == {"beta"}
    with pytest.raises(ParameterError, match="length_m is 'x'; expected a number"):
        names(least_length_m="x")
    with pytest.raises(CsasError, match="disabled"):
        names(where="(SELECT count(*) FROM read_text('/etc/passwd')) > 0")


def test_a_catalogue_that_is_made_anew_is_shown(season: Path, results: Path, tmp_path: Path) -> None:
    root = tmp_path / "season"
    shutil.copytree(season, root)
    content = Content(root)
    add(root, "delta", results)
    rebuild(root)
    assert content.answer({})["count"] == 5


def test_a_thumbnail_is_the_plan_of_the_object(season: Path, results: Path) -> None:
    content = Content(season)
    one = next(row["results"] for row in content.answer({"verdict": "object"})["rows"])
    picture = np.array(Image.open(io.BytesIO(content.thumbnail(one))))
    assert picture.shape == (96, 96, 3)
    lit = picture[..., 0] > 60
    occupied = np.load(results / "grid.npz")["occupied"].any(axis=0)
    rows, cols = np.nonzero(occupied)
    side = 1.3 * max(np.ptp(rows) + 1, np.ptp(cols) + 1)
    assert lit.mean() == pytest.approx(occupied.sum() / side**2, rel=0.05)
    # The box is turned by 20 degrees, north up: east of its middle it lies higher in the picture.
    v, u = np.nonzero(lit)
    assert np.cov(u, v)[0, 1] < 0
    for wrong in ("", "runs", "../season", "/etc", f"{one}/.."):
        with pytest.raises(ArchiveError, match="there are no results"):
            content.thumbnail(wrong)


def test_the_server_answers_its_own_page_alone(serve_archive: Any) -> None:
    server = serve_archive()
    url = server.url
    rows = json.loads(ask(f"{url}api/rows?verdict=object")[1])["rows"]
    one = {"results": rows[0]["results"]}
    assert ask(f"{url}api/rows", Host="evil.example")[0] == 403
    assert ask(f"{url}api/rows", Origin="http://evil.example")[0] == 403
    assert ask(f"{url}api/open", one)[0] == 403
    assert ask(f"{url}api/open", one, Origin="http://evil.example")[0] == 403
    own = url.rstrip("/")
    assert ask(f"{url}api/open", {"results": "../x"}, Origin=own)[0] == 404
    assert ask(f"{url}api/open", ["x"], Origin=own)[0] == 400
    assert ask(f"{url}api/rows?where=nonsense(")[0] == 404
    assert ask(f"{url}static/../server.py")[0] in (403, 404)
    asked = urllib.request.urlopen(url, timeout=60)
    assert "default-src 'self'" in asked.headers["Content-Security-Policy"]
    asked.close()


def test_a_token_is_asked_for_of_the_archive_and_of_its_runs(serve_archive: Any) -> None:
    server = serve_archive(token="a long enough token")
    bare = f"http://127.0.0.1:{server.port}/"
    assert ask(f"{bare}api/rows")[0] == 401
    token = urllib.parse.urlencode({"token": server.token})
    row = json.loads(ask(f"{bare}api/rows?verdict=object&{token}")[1])["rows"][0]
    status, said = ask(f"{bare}api/open?{token}", {"results": row["results"]}, Origin=bare.rstrip("/"))
    opened = json.loads(said)["url"]
    assert status == 200
    assert ask(opened)[0] == 200
    assert ask(opened.partition("?")[0])[0] == 401


@pytest.mark.long
def test_so_many_runs_are_open_at_once_and_end_with_the_archive(serve_archive: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("csas_shadow_ros.archive_page.server.MOST_OPEN", 2)
    server = serve_archive()
    own = server.url.rstrip("/")
    results = [row["results"] for row in json.loads(ask(f"{own}/api/rows?verdict=object")[1])["rows"]]
    urls = [
        json.loads(ask(f"{own}/api/open", {"results": r}, Origin=own)[1])["url"]
        for r in (*results, results[-1])
    ]
    assert len(set(urls)) == 3
    assert urls[-1] == urls[-2]
    assert ask(urls[-1])[0] == 200
    with pytest.raises(urllib.error.URLError):
        ask(urls[0])
    server.stop()
    with pytest.raises(urllib.error.URLError):
        ask(urls[-1])


def test_the_page_shows_filters_and_opens(watched: Any, serve_archive: Any) -> None:
    server = serve_archive()
    page = watched.page
    page.goto(server.url)
    watched.until("document.querySelectorAll('#rows tr').length === 4")
    assert page.locator("#count").inner_text() == "4 rows"
    assert HOSTILE in page.locator("#rows").inner_text()
    watched.until("[...document.images].filter(i => i.complete && i.naturalWidth === 96).length === 3")
    # On the map beta lies north-east of alpha, some 22 m apart in each direction.
    at = watched.js("archive.state.points.map(p => [p.lat, ...archive.screen(p), archive.state.scale])")
    (_, ax, ay, scale), (_, bx, by, _) = sorted(at)
    assert (bx - ax) / scale == pytest.approx(22.2, abs=0.2)
    assert (ay - by) / scale == pytest.approx(22.2, abs=0.2)
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + bx, box["y"] + by)
    assert "beta" in page.locator("tr.chosen").inner_text()
    page.mouse.move(box["x"] + 50, box["y"] + 50)
    page.mouse.wheel(0, -400)
    watched.until(f"archive.state.scale > {scale} * 2")
    page.locator("input[name=where]").fill("nonsense(")
    watched.until("document.getElementById('error').textContent.includes('nonsense')")
    page.locator("button[type=reset]").click()
    page.locator("select[name=status]").select_option("failed")
    watched.until("document.querySelectorAll('#rows tr').length === 1")
    assert "no track" in page.locator("#rows").inner_text()
    assert page.locator("#no-map").is_visible()
    page.locator("button[type=reset]").click()
    watched.until("document.querySelectorAll('#rows tr').length === 4")
    # The filters' own failed questions are the only errors of the console.
    watched.said[:] = [line for line in watched.said if "404" not in line]
    with page.context.expect_page() as opened:
        page.locator("#rows button", has_text="alpha").click()
    run = opened.value
    run.wait_for_selector("#contacts li")
    assert run.url != server.url
    run.close()


def test_the_command_shows_an_archive_until_it_is_told_to_end(season: Path, capsys: Any) -> None:
    command = [sys.executable, "-m", "csas_shadow_ros", "view", str(season), "--no-browser"]
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd="/"
    )
    url = running.stdout.readline().strip()
    assert json.loads(ask(f"{url}api/rows")[1])["count"] == 4
    running.send_signal(signal.SIGINT)
    assert running.wait(60) == 0
    running.stdout.close()
    assert main(["view", str(season), str(season)]) == 1
    assert "is an archive; expected one alone" in capsys.readouterr().err
