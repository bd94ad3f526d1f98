"""One HTML file that opens without a server, on a machine without anything but a browser."""

from __future__ import annotations

import base64
import json
from typing import Any

from .server import STATIC
from .store import SECOND, ViewStore

_SHOWN = ("sub_aperture", "shadow", "likelihood")


def _data(body: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(body).decode()}"


def export_html(store: ViewStore, step: int = 1) -> bytes:
    """Make a page that holds every `step`-th view of each set, the composites and the volumes.

    Parameters
    ----------
    store : ViewStore
        What is shown.
    step : int
        1: all views; a file of 360 views of 800² pixels in two sets is 250 MB.
    """
    scene = store.scene()
    files: dict[str, str] = {}
    for name, about in scene["sets"].items():
        about["views"] = sorted(about["views"], key=lambda v: v["aspect_deg"])[::step]
        for view in about["views"]:
            stamp, path = int(view["stamp"]), f"{view['stamp']}/{view['rev']}"
            plain = name.removeprefix(SECOND)
            if plain in _SHOWN:
                address = f"api/view/{name}/{path}.jpg"
                files[address] = _data(store.view_picture(name, stamp, "jpg"), "image/jpeg")
            elif plain == "shadow_mask":
                lines = json.dumps(store.contour(stamp, name)).encode()
                asked = "" if name == plain else f"?set={name}"
                files[f"api/contour/{path}.json{asked}"] = _data(lines, "application/json")
        if name.removeprefix(SECOND) not in (*_SHOWN, "shadow_mask"):
            about["views"] = []
    if scene["live"]:
        scene["damage"] = scene["damage"] or f"saved while the run went on: {scene['status']}"
    scene["reduced"], scene["live"] = False, False
    if not scene["desk"]["why"]:
        scene["desk"]["why"] = "this is a saved file: judge in the viewer of the run"
    for name, about in scene["meshes"].items():
        files[f"api/surface-of/{name}/{about['rev']}.json"] = _data(store.mesh(name), "application/json")
    for name, about in scene["pictures"].items():
        files[f"api/picture/{name}/{about['rev']}.png"] = _data(store.composite_picture(name), "image/png")
    for name, about in scene["volumes"].items():
        octets = _data(store.volume(name), "application/octet-stream")
        files[f"api/volume/{name}/{about['rev']}.bin"] = octets
    files["static/worker.js"] = _data((STATIC / "worker.js").read_bytes(), "text/javascript")
    return _page({"scene": scene, "files": files})


def _page(content: dict[str, Any]) -> bytes:
    page = (STATIC / "index.html").read_text(encoding="utf-8")
    style = (STATIC / "app.css").read_text(encoding="utf-8")
    script = (STATIC / "app.js").read_text(encoding="utf-8").replace("</script", "<\\/script")
    # "<" as an escape: no text in the run can end the element that holds it.
    data = json.dumps(content).replace("<", "\\u003c")
    page = page.replace('<link rel="stylesheet" href="static/app.css">', f"<style>{style}</style>")
    held = f'<script type="application/json" id="content">{data}</script>'
    return page.replace(
        '<script type="module" src="static/app.js"></script>',
        f'{held}<script type="module">{script}</script>',
    ).encode()
