"""The store behind the page, and who is answered by its server."""

from __future__ import annotations

import gc
import json
import shutil
import socket
import threading
import time
import urllib.error
import urllib.request
import warnings
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from synthetic import entry

from csas_shadow_ros.bags import BagReader, BagWriter, read_run
from csas_shadow_ros.bags.index import BagIndex
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.parameters import SubApertureParameters
from csas_shadow_ros.core.shape.mesh import mesh_from_grid
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.viewer import codes
from csas_shadow_ros.viewer.derived import Reduced
from csas_shadow_ros.viewer.server import ViewerServer, is_loopback
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import Spool, ViewerError, ViewStore


def get(url: str, **headers: str) -> tuple[int, bytes]:
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def cut(results: Path, tmp_path: Path) -> Path:
    """A copy of a results folder whose bag was cut off in the middle."""
    out = tmp_path / "cut"
    shutil.copytree(results, out)
    bag = out / "result.mcap"
    with bag.open("r+b") as file:
        file.truncate(bag.stat().st_size // 2)
    return out


def test_a_bag_that_was_cut_off_is_shown_and_said_to_be(results, tmp_path) -> None:
    store = ViewStore()
    source = PathSource(store, cut(results, tmp_path))
    source.start()
    assert source.done.wait(60)
    assert 0 < len(store.sets["shadow"]) < 72
    assert "result.mcap" in store.scene()["damage"]


def test_what_was_found_is_there_before_the_first_view(results):
    order = []

    class Noted(ViewStore):
        def put_part(self, name, value):
            order.append(name)
            super().put_part(name, value)

        def put_desk(self, document):
            order.append("desk")
            super().put_desk(document)

        def put_view(self, name, entry):
            order.append("view")
            super().put_view(name, entry)

    source = PathSource(Noted(), results)
    source.start()
    assert source.done.wait(60)
    assert {"report", "contacts", "desk"} <= set(order[: order.index("view")])


def test_a_grid_that_is_none_is_named_and_no_page_is_saved_without_it(results, tmp_path, capsys) -> None:
    folder, page = tmp_path / "bad", tmp_path / "page.html"
    shutil.copytree(results, folder)
    (folder / "grid.npz").write_bytes(b"no grid at all")
    assert main(["view", str(folder), "--html", str(page)]) == 1
    assert "grid.npz cannot be read" in capsys.readouterr().err
    assert not page.exists()


def test_views_of_two_namespaces_need_a_name(results, tmp_path, capsys) -> None:
    two = tmp_path / "two"
    with BagReader(results / "result.mcap") as reader, BagWriter(two) as writer:
        for message in reader.messages(["shadow/image", "shadow/camera_info"]):
            for name in ("port", "starboard"):
                topic = message.topic.replace("/csas/", f"/{name}/")
                writer.write(topic, message.cdr, message.log_time_ns, type_name=message.type_name)
    page = tmp_path / "page.html"
    assert main(["view", str(two), "--html", str(page), "--every", "36"]) == 1
    assert "/port and of /starboard" in capsys.readouterr().err
    assert main(["view", str(two), "--namespace", "port", "--html", str(page), "--every", "36", "-q"]) == 0


@pytest.mark.parametrize("where", ["nowhere/page.html", "."])
def test_a_page_that_cannot_be_written_is_refused_in_one_line(results, tmp_path, capsys, where: str) -> None:
    assert main(["view", str(results), "--html", str(tmp_path / where)]) == 1
    error = capsys.readouterr().err
    assert "cannot write" in error
    assert "Traceback" not in error


def test_a_run_without_an_object_says_so_instead_of_asking_for_another_run(tmp_path, capsys) -> None:
    assert main(["simulate", str(tmp_path / "empty"), "--profile", "tiny", "--target", "empty", "-q"]) == 0
    given = ["--out", str(tmp_path / "out"), "--step-deg", "10", "--no-figures", "-q"]
    assert main(["run", str(tmp_path / "empty"), *given]) == 0
    capsys.readouterr()
    assert main(["view", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert "no object" in error
    assert "make them" not in error


def test_reduced_views_of_another_run_have_other_addresses(tiny_box_bag) -> None:
    run = read_run(tiny_box_bag.path)
    image, revisions = run.coherent_image(), set()
    for pixels in (image.pixels, image.pixels * np.complex64(2)):
        store = ViewStore()
        store.put_view("shadow", entry(0))
        Reduced(replace(image, pixels=pixels), run.require_track(), SubApertureParameters()).fill(store)
        revisions |= {each.revision for each in store.sets["reduced"].values()}
    assert len(revisions) == 2


def test_a_token_is_told_so_that_its_address_opens(serve) -> None:
    url = serve(ViewStore(), host="0.0.0.0", token="a b&c#é, and more")
    assert "0.0.0.0" not in url
    assert get(url.replace(socket.gethostname(), "127.0.0.1"))[0] == 200


def test_codes_are_levels_over_the_median_to_half_a_step() -> None:
    rng = np.random.default_rng(0)
    amplitude = rng.rayleigh(3.0, (200, 200)).astype(np.float32)
    amplitude[0, 0] = np.nan
    made = codes.amplitude_codes(amplitude)
    assert made[0, 0] == 0
    db = 20 * np.log10(amplitude / np.nanmedian(amplitude))
    told = codes.LOW_DB + codes.STEP_DB * (made.astype(float) - 1)
    inside = (made > 1) & (made < 255)
    assert np.abs(told - db)[inside].max() <= codes.STEP_DB / 2 + 1e-3


def test_a_likelihood_comes_back_of_its_codes_to_half_a_step_and_unknown_stays_unknown() -> None:
    values = np.linspace(0, 1, 500, dtype=np.float32).reshape(20, 25)
    values[3, 3] = np.nan
    back = codes.likelihood_of(codes.likelihood_codes(values))
    assert np.isnan(back[3, 3])
    assert np.nanmax(np.abs(back - values)) <= 0.5 / 254 + 1e-6


def test_what_the_spool_keeps_comes_back(tmp_path) -> None:
    spool, rng = Spool(), np.random.default_rng(1)
    arrays = [rng.integers(0, 255, (n, 7), np.uint8) for n in (3, 50, 9)]
    loads = [spool.put(a) for a in arrays]
    for array, load in zip(arrays, loads, strict=True):
        np.testing.assert_array_equal(load(), array)


def test_the_same_view_again_is_no_news_and_a_view_of_another_run_clears_the_store() -> None:
    store, told = ViewStore(), []
    store.listeners.append(told.append)
    for i in range(5):
        store.put_view("shadow", entry(i))
        store.put_view("shadow", entry(i))
    assert [n["type"] for n in told] == ["view"] * 5
    other = entry(2)
    moved = type(other.info)(**{**vars(other.info), "stamp_ns": 7})
    store.put_view("shadow", type(other)(moved, "x", other.load))
    assert list(store.sets["shadow"]) == [7]
    assert [n["type"] for n in told[5:]] == ["all", "view"]


def test_a_finished_run_shows_every_set_and_both_methods(run_store) -> None:
    scene = run_store.scene()
    assert {n: len(s["views"]) for n, s in scene["sets"].items() if n != "reduced"} == {
        "sub_aperture": 72,
        "shadow": 72,
        "likelihood": 72,
        "shadow_mask": 72,
    }
    assert {v["method"] for v in scene["volumes"].values()} == {"consensus", "soft"}
    assert scene["dimensions"]["intervals"]["length_m"]
    assert set(scene["pictures"]) == {"multilook", "color_by_aspect"}


def test_a_bag_without_views_is_refused_with_what_to_do(tiny_box_bag) -> None:
    with pytest.raises(ViewerError, match=r"holds no views.*csas-shadow run"):
        PathSource(ViewStore(), tiny_box_bag.path)


def test_a_bag_alone_gives_dimensions_with_intervals(results) -> None:
    store = ViewStore()
    source = PathSource(store, results / "result.mcap")
    source.start()
    assert source.done.wait(60)
    assert store.scene()["dimensions"]["intervals"]["length_m"]
    assert len(mesh_from_grid(store.grids["main"]).faces) > 0


@pytest.mark.parametrize(
    ("host", "here"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("sonar", False)],
)
def test_loopback_is_told_from_the_network(host: str, here: bool) -> None:
    assert is_loopback(host) is here
    assert (ViewerServer(ViewStore(), host).token is None) is here


def test_on_the_network_nothing_is_answered_without_the_token(serve) -> None:
    url = serve(ViewStore(), host="0.0.0.0")
    bare, _, token = url.replace("0.0.0.0", "127.0.0.1").partition("?token=")
    assert len(token) >= 20
    for path in ("", "api/scene", "static/app.js", "ws", "api/export.html"):
        assert get(bare + path)[0] == 401
        assert get(f"{bare}{path}?token=wrong")[0] == 401
    assert get(f"{bare}?token={token}")[0] == 200
    assert get(f"{bare}api/scene", Cookie=f"csas_viewer_token_{urlparse(url).port}={token}")[0] == 200


def test_a_page_of_somebody_else_is_not_answered(serve) -> None:
    url = serve(ViewStore())
    assert get(f"{url}api/scene")[0] == 200
    assert get(f"{url}api/scene", Origin="http://elsewhere.example")[0] == 403
    assert get(f"{url}api/scene", Host="elsewhere.example")[0] == 403


@pytest.mark.parametrize(("path", "code", "word"), [
    ("api/view/shadow/1/0.jpg", 404, "no view"), ("api/volume/main/0.bin", 404, "no volume"),
    ("api/surface/main.json?threshold=x", 404, "no volume"), ("api/export.html?step=0", 400, "step is '0'"),
    ("static/../server.py", 404, ""),
])  # fmt: skip
def test_what_is_not_there_is_named(serve, path: str, code: int, word: str) -> None:
    status, body = get(serve(ViewStore()) + path)
    assert status == code
    assert word in body.decode()


def test_a_page_that_has_stopped_reading_keeps_no_socket_open() -> None:
    store = ViewStore()
    volume = Volume.around((0.0, 0.0), (4.0, 4.0, 4.0), 0.02)  # 8 MB: more than the system's buffers hold
    likelihood = np.random.default_rng(1).random(volume.shape, np.float32)
    views = np.full(volume.shape, 9, np.uint16)
    store.put_grid("main", VoxelGrid(volume, likelihood, views, 0.5, likelihood < 0.5, "soft"))
    server = ViewerServer(store)
    server.start()
    revision = json.loads(get(f"{server.url}api/scene")[1])["volumes"]["main"]["rev"]
    with socket.create_connection(("127.0.0.1", server.port)) as stuck:
        asked = f"GET /api/volume/main/{revision}.bin HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n"
        stuck.sendall(asked.encode())
        assert stuck.recv(1) == b"H"
        server.stop()
        gc.collect()  # what is left open warns when it is collected, and a warning fails a test


def test_the_first_views_of_a_recorded_bag_are_there_before_the_rest_is_read(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder logs messages later than they are stamped: where a view lies tells only the view itself."""
    with (results / "result.mcap").open("rb") as file, (tmp_path / "r.mcap").open("wb") as made:
        writer = Writer(made, chunk_size=1000)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", known)
            late = message.log_time + 7
            writer.add_message(channels[channel.topic], late, message.data, message.publish_time)
        writer.finish()
    told: list[str] = []
    at, put = BagIndex._at, ViewStore.put_view
    monkeypatch.setattr(BagIndex, "_at", staticmethod(lambda *a: told.append("read") or at(*a)))
    monkeypatch.setattr(ViewStore, "put_view", lambda s, name, view: told.append(name) or put(s, name, view))
    source = PathSource(ViewStore(), tmp_path / "r.mcap")
    source.start()
    assert source.done.wait(60)
    assert told[:4] == ["read", "shadow", "read", "sub_aperture"]
    assert [told.count(name) for name in ("shadow", "sub_aperture", "likelihood")] == [72, 72, 72]


def test_a_server_that_ends_while_pages_knock_closes_every_socket() -> None:
    """asyncio loses a connection that it has accepted and not yet given to a server that closes."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for tried in range(40):
            server = ViewerServer(ViewStore())
            server.start()
            ended = threading.Event()
            knocking = threading.Thread(target=_knock, args=(server.port, ended))
            knocking.start()
            time.sleep(0.0007 * tried)
            server.stop()
            ended.set()
            knocking.join()
            del server
            gc.collect()
    assert [str(w.message) for w in seen if issubclass(w.category, ResourceWarning)] == []


def _knock(port: int, ended: threading.Event) -> None:
    """Connect until nobody answers; ask something through every second connection."""
    held: list[socket.socket] = []
    while not ended.is_set():
        try:
            held.append(socket.create_connection(("127.0.0.1", port), timeout=1.0))
            if len(held) % 2:
                held[-1].sendall(b"GET /api/scene HTTP/1.1\r\nHost: localhost\r\n\r\n")
        except OSError:
            break
    for each in held:
        each.close()
