"""Judgements: kept whole, merged, refused to strangers, and in every file that leaves the page."""

from __future__ import annotations

import http.client
import json
import math
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import pytest

from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.results.check import check_results
from csas_shadow_ros.viewer.desk import FILE, Desk
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import ViewerError, ViewStore

CONTACT = "object-1"


def judged(verdict: str, base: int = 0, *, remark: str = "", name: str = CONTACT) -> dict[str, Any]:
    value = {"verdict": verdict, "remark": remark, "operator": "A"}
    return {"id": name, "kind": "judgement", "base": base, "value": value}


def post(url: str, body: Any, **headers: str) -> tuple[int, str]:
    """Post JSON as the page itself does, unless the headers say otherwise."""
    at = urlparse(url)
    sent = {"Content-Type": "application/json", "Origin": f"http://{at.netloc}"} | {
        k.replace("_", "-"): v for k, v in headers.items()
    }
    connection = http.client.HTTPConnection(at.hostname or "", at.port, timeout=10)
    query = f"?{at.query}" if at.query else ""
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request("POST", f"/api/desk{query}", data, {k: v for k, v in sent.items() if v})
    answer = connection.getresponse()
    told = answer.read().decode()
    connection.close()
    return answer.status, told


@pytest.fixture
def served(serve: Any, tmp_path: Path) -> tuple[str, ViewStore, Desk]:
    store = ViewStore(title="judged")
    store.desk = Desk(tmp_path)
    store.put_desk(store.desk.document())
    return serve(store), store, store.desk


def test_a_judgement_survives_a_restart_and_is_no_damage_to_the_results(
    tmp_path: Path, results: Path
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for path in results.iterdir():
        (folder / path.name).symlink_to(path) if path.is_file() else None
    Desk(folder).change([judged("mine-like", remark="two fins\nund Ä")])
    item = Desk(folder).document()["items"][CONTACT]
    assert item["value"] == {"verdict": "mine-like", "remark": "two fins\nund Ä", "operator": "A"}
    assert sorted(p.name for p in folder.iterdir() if "desk" in p.name) == [FILE]
    problems = [f for f in check_results(folder).findings if "desk" in f.file]
    assert problems == []


def test_two_that_judge_at_once_lose_nothing(tmp_path: Path) -> None:
    # Two servers of one folder: each has a desk of its own.
    pages = [Desk(tmp_path) for _ in range(4)]

    def judge(number: int) -> None:
        for i in range(12):
            pages[number].change([judged("undecided", remark=f"{number}-{i}")])
            mark = {"aspect_deg": i, "name": ""}
            pages[number].change([{"id": f"b-{number}-{i}", "kind": "bookmark", "base": 0, "value": mark}])

    threads = [threading.Thread(target=judge, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    items = Desk(tmp_path).document()["items"]
    assert sum(i["kind"] == "bookmark" for i in items.values()) == 48
    item = items[CONTACT]
    remarks = {one["value"]["remark"] for one in [item, *item["earlier"]]}
    assert remarks == {f"{n}-{i}" for n in range(4) for i in range(12)}


def test_whoever_saw_a_judgement_replaces_it_and_removes_it_and_nobody_else_does(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    first = desk.change([judged("undecided")])["items"][CONTACT]["revision"]
    second = desk.change([judged("mine-like", first)])["items"][CONTACT]
    assert second["earlier"] == []
    gone = {"id": CONTACT, "kind": "judgement", "base": first, "value": None}
    assert CONTACT in desk.change([gone])["items"], "another has changed it since"
    assert CONTACT not in desk.change([gone | {"base": second["revision"]}])["items"]


#: Forks writers and kills each of them; what it reads after each is printed.
KILLER = """
import itertools, os, signal, sys, time
from csas_shadow_ros.viewer.desk import Desk
desk = Desk(sys.argv[1])
for round in range(40):
    ready, go = os.pipe()
    writer = os.fork()
    if not writer:
        for i in itertools.count():
            value = {"verdict": "undecided", "remark": str(i) * 200, "operator": ""}
            base = desk.document()["items"].get("object-1", {"revision": 0})["revision"]
            desk.change([{"id": "object-1", "kind": "judgement", "base": base, "value": value}])
            os.write(go, b".")
    os.read(ready, 1)
    time.sleep(0.0007 * round)
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)
    os.close(ready), os.close(go)
    remark = desk.document()["items"]["object-1"]["value"]["remark"]
    assert remark == remark[: len(remark) // 200] * 200
    print(sorted(os.listdir(sys.argv[1])))
"""


def test_a_writer_that_is_killed_at_any_moment_leaves_the_old_file_or_the_new(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLER, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    whole, half = str([FILE]), str([f".{FILE}.new", FILE])
    lines = done.stdout.splitlines()
    assert len(lines) == 40
    assert set(lines) <= {whole, half}
    Desk(tmp_path).change([judged("mine-like", 10**6)])
    assert {p.name for p in tmp_path.iterdir()} == {FILE}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "csas_shadow_ros desk 2", "items": {}}',
    '{"format": "csas_shadow_ros desk 1", "revision": 1, "items": {"a": {"kind": "x"}}}'])  # fmt: skip
def test_a_file_that_is_none_is_named_and_never_written_over(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    with pytest.raises(ViewerError, match=r"desk\.json cannot be read"):
        Desk(tmp_path).change([judged("undecided")])
    assert (tmp_path / FILE).read_text() == text


@pytest.mark.parametrize("change", [
    None, {}, judged("perhaps"), judged("undecided", name="../x"), judged("undecided", -1),
    judged("undecided", remark="x" * 2001), judged("undecided") | {"kind": "file"},
    {"id": "b-1", "kind": "bookmark", "base": 0, "value": {"aspect_deg": float("nan")}},
    {"id": "r-1", "kind": "ruler", "base": 0, "value": {"aspect_deg": 1, "stamp": "x", "ends": [[0, 0]] * 2}},
    {"id": "r-1", "kind": "ruler", "base": 0, "value": {"aspect_deg": 1, "stamp": "1", "ends": [[0, 0]]}},
])  # fmt: skip
def test_what_is_no_judgement_is_refused_with_all_that_came_with_it(tmp_path: Path, change: Any) -> None:
    with pytest.raises(ParameterError, match="expected"):
        Desk(tmp_path).change([judged("undecided"), change])
    assert not (tmp_path / FILE).exists()


def test_a_file_does_not_grow_for_ever(tmp_path: Path) -> None:
    many = [judged("undecided", remark="x" * 2000, name=f"object-{i}") for i in range(600)]
    with pytest.raises(ViewerError, match="expected 1048576 at most"):
        Desk(tmp_path).change(many)
    assert not (tmp_path / FILE).exists()


def test_the_page_may_write_that_file_and_strangers_may_not(served: tuple[str, ViewStore, Desk]) -> None:
    url, store, desk = served
    body = {"items": [judged("undecided")]}
    assert post(url, body, Origin="http://elsewhere.example")[0] == 403
    assert post(url, body, Origin="")[0] == 403, "who does not say where it comes from"
    assert post(url, body, Sec_Fetch_Site="cross-site")[0] == 403
    assert post(url, body, Host="elsewhere.example")[0] == 403
    assert post(url, body, Content_Type="text/plain")[0] == 415
    assert post(url, {"item": []})[0] == post(url, b"{")[0] == post(url, b"[" * 100_000)[0] == 400
    assert post(url, b" " * (1 << 19))[0] == 413
    assert desk.document()["revision"] == 0
    assert post(url, body)[0] == 200
    assert store.scene()["desk"]["items"][CONTACT]["value"]["verdict"] == "undecided"


def test_on_the_network_a_judgement_needs_the_token_too(serve: Any, tmp_path: Path) -> None:
    store = ViewStore()
    store.desk = Desk(tmp_path)
    url = serve(store, host="0.0.0.0")
    at, _, token = url.replace(urlparse(url).hostname or "", "127.0.0.1").partition("?token=")
    body = {"items": [judged("undecided")]}
    assert post(at, body)[0] == post(f"{at}?token=wrong", body)[0] == 401
    assert post(f"{at}?token={token}", body, Origin="http://elsewhere.example")[0] == 403
    assert not (tmp_path / FILE).exists()
    assert post(f"{at}?token={token}", body)[0] == 200


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_page_can_write_nothing_else(serve: Any, results: Path, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(results, folder)
    store = ViewStore()
    source = PathSource(store, folder)
    source.start()
    assert source.done.wait(60)
    url, before = serve(store), files(folder)
    at, stamp = urlparse(url), next(iter(store.sets["shadow"]))
    api = ("scene", "desk", f"view/shadow/{stamp}/x.png", f"contour/{stamp}/x.json", "volume/main/x.bin",
           "surface/main.json", "mesh/main.stl", "reduced", "export.html", "circle.gif",
           "report.pdf")  # fmt: skip
    paths = ["/", "/ws", "/static/app.js", "/desk.json", "/../grid.npz", "/report.json"]
    paths += [f"/api/{name}" for name in api]
    sent = {"Content-Type": "application/json", "Origin": f"http://{at.netloc}"}
    for path in paths:
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            if (method, path) == ("POST", "/api/desk"):
                continue
            connection = http.client.HTTPConnection(at.hostname or "", at.port, timeout=10)
            connection.request(method, path, json.dumps({"items": [judged("undecided")]}), sent)
            assert connection.getresponse().status in (404, 405), (method, path)
            connection.close()
    for name in ("../report", "report.json", "a/b", "", "A", "x" * 65):
        assert post(url, {"items": [judged("undecided", name=name)]})[0] == 400, name
    assert files(folder) == before
    assert post(url, {"items": [judged("undecided")]})[0] == 200
    after = files(folder)
    assert after.keys() - before.keys() == {FILE}
    assert {name: after[name] for name in before} == before


def test_where_there_is_no_folder_nothing_is_written(serve: Any) -> None:
    status, told = post(serve(ViewStore()), {"items": [judged("undecided")]})
    assert status == 409
    assert "results folder" in told


def test_results_that_are_made_again_keep_the_judgement_out_of_their_checksums(
    tmp_path: Path, results: Path, tiny_box_bag: Any
) -> None:
    from csas_shadow_ros.durable import write_checksums

    Desk(tmp_path).change([judged("undecided")])
    (tmp_path / "grid.npz").write_bytes(b"x")
    write_checksums(tmp_path, {})
    assert FILE not in (tmp_path / "SHA256SUMS").read_text()


def test_the_report_is_one_page_with_the_judgement_the_dimensions_and_the_damage(
    results: Path, tmp_path: Path, capsys: Any
) -> None:
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(results, folder)
    report = json.loads((folder / "report.json").read_text())
    report["views"] |= {"lost": 3, "rejected": 2, "reasons": {"too <dark>": 2}}
    report["datum"] = {"heading_deg": 30.0}
    report["objects"][0] |= {"place": {"latitude_deg": -60.5, "longitude_deg": 5.25}}
    (folder / "report.json").write_text(json.dumps(report))
    Desk(folder).change([judged("mine-like", remark="fins & <b>")])
    page, sheet = tmp_path / "r.html", tmp_path / "r.pdf"
    assert main(["report", str(folder), "--out", str(page), "-q"]) == 0
    text = page.read_text(encoding="utf-8")
    length, axis = report["dimensions"]["length_m"], math.degrees(report["dimensions"]["heading_rad"])
    for told in ("mine-like", "judged by A", "fins &amp; &lt;b&gt;", f"{length:.2f} ± ", "3 views lost",
                 "2 rejected: too &lt;dark&gt;", "60.500000° S, 5.250000° E", "csas-shadow",
                 f"{(120 - axis) % 180:05.1f} ± "):  # fmt: skip
        assert told in text, told
    assert text.count("<img ") == 5
    assert "http:" not in text
    assert main(["report", str(folder), "--out", str(sheet), "-q"]) == 0
    body = sheet.read_bytes()
    assert body.startswith(b"%PDF")
    assert body.count(b"/Type /Page ") + body.count(b"/Type /Page\n") == 1
    assert main(["report", str(folder), "--out", str(tmp_path / "r.doc")]) == 1
    assert "expected a name that ends with .pdf or .html" in capsys.readouterr().err
    assert main(["report", str(folder), "--contact", "9", "--out", str(sheet)]) == 1
    assert "expected one of: object-1" in capsys.readouterr().err


@pytest.mark.long
def test_the_circle_is_a_moving_picture_of_every_view(results: Path, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "circle.gif"
    assert main(["view", str(results), "--gif", str(path), "-q"]) == 0
    with Image.open(path) as picture:
        assert picture.n_frames == 72
        assert picture.size == (420, 420)
        colours = {c for _, c in picture.convert("RGB").getcolors() or []}
        assert (41, 216, 90) in colours, "the sonar is green"
        assert len(colours) <= 32
        first = picture.convert("RGB").tobytes()
        picture.seek(18)
        assert picture.convert("RGB").tobytes() != first


def test_what_no_sonar_has_seen_is_not_printed_as_shadow() -> None:
    import numpy as np
    from synthetic import PIXELS, SPACING_M, entry

    from csas_shadow_ros.viewer.crop import Window, grey_of

    one = entry(0)
    pixels = one.load().copy()
    pixels[: PIXELS // 2] = 0
    half = type(one)(one.info, "half", lambda: pixels)
    window = Window((0.0, 0.0), 1.5 * PIXELS * SPACING_M, (0.6, 0.8), 300)
    seen, whole = grey_of(window, half, "amplitude", 255), grey_of(window, one, "amplitude", 255)
    level = whole[150, 150]
    assert set(np.unique(whole)) == {level, 255}
    assert set(np.unique(seen)) == {level, 255}, "no dark fringe where what is known ends"
    assert (seen == level).sum() == pytest.approx((whole == level).sum() / 2, rel=0.03)


def test_what_no_sonar_has_seen_is_white_in_the_colours_too(run_store: ViewStore) -> None:
    import numpy as np

    from csas_shadow_ros.viewer.crop import Window, colours_of

    store = ViewStore()
    for name in ("multilook", "color_by_aspect"):
        info, _, pixels = run_store.pictures[name]
        half = pixels.copy()
        half[: len(half) // 2] = 0
        store.put_picture(name, info, half)
    window = Window((0.0, 0.0), 1.0, (0.0, 1.0), 300)
    seen, whole = colours_of(window, store, 255), colours_of(window, run_store, 255)
    white = (seen == 255).all(axis=2)
    assert white.mean() == pytest.approx(0.5, abs=0.03)
    assert np.array_equal(seen[~white], whole[~white]), "no dark fringe where what is known ends"
