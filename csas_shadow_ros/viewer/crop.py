"""What lies round a contact, cut out of a view: for the report and the moving picture."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..core.geometry import ViewInfo
from . import codes
from .codes import LOW_DB, STEP_DB
from .contacts import north_shown_deg
from .store import SETS, Entry, ViewerError, ViewStore

#: Levels from black to white, dB over the view's median: as the page opens.
LOW_SHOWN_DB, HIGH_SHOWN_DB = -20.0, 18.0
#: A moving picture has so many frames at most, and so many a second: a circle in some seven seconds.
_FRAMES, _FRAMES_PER_S = 72, 10.0
_GIF_PX = 420
#: Greys of a moving picture: speckle packs badly, and each halving of them takes a sixth of the file.
_GREYS = 28
_GREEN, _AMBER, _RING, _BACKGROUND = (41, 216, 90), (255, 179, 71), (143, 163, 176), (11, 15, 18)


def contact_named(store: ViewStore, name: str = "") -> dict[str, Any]:
    """Return a contact by its name; without one the first, or what is carved where nobody has told of any.

    Raises
    ------
    ViewerError
        If there is none of that name.
    """
    scene = store.scene()
    contacts = scene["contacts"]
    if name:
        found = next((c for c in contacts if c["id"] == name), None)
        if found is None:
            known = ", ".join(c["id"] for c in contacts) or "none"
            raise ViewerError(f"there is no contact {name[:40]!r}; expected one of: {known}")
        return dict(found)
    if contacts:
        return dict(contacts[0])
    box = scene["target"] or {"centre": [0.0, 0.0], "size": [2.0, 2.0, 0.5]}
    return {
        "id": "",
        "name": "No contact",
        "kind": "none",
        "position_m": list(box["centre"][:2]),
        "size_m": 0.75 * max(box["size"][:2]),
        "dimensions": None,
        "geographic": None,
        "volume": "main",
    }


def shadow_m(info: ViewInfo, contact: Mapping[str, Any]) -> float:
    """Return how long a contact's shadow is in a view."""
    height = float(contact.get("height_m") or 0.4)
    sonar = info.camera.sonar_m
    ground = math.hypot(sonar[0] - contact["position_m"][0], sonar[1] - contact["position_m"][1])
    return height * ground / max(0.1, float(sonar[2]) - height)


class Window:
    """A square of seabed as a square picture.

    Parameters
    ----------
    centre : (float, float)
        Scene (x, y) of its middle.
    side_m : float
        Its side.
    up : (float, float)
        Which way is up in the picture, a unit vector.
    pixels : int
        Side of the picture.
    """

    def __init__(self, centre: Sequence[float], side_m: float, up: tuple[float, float], pixels: int) -> None:
        self.side_m, self.pixels = side_m, pixels
        spacing = side_m / pixels
        right = (up[1], -up[0])
        middle = (pixels - 1) / 2
        # Picture (column, row, 1) → scene (x, y, 1).
        self.to_ground = np.array(
            [
                [spacing * right[0], -spacing * up[0], centre[0] - middle * spacing * (right[0] - up[0])],
                [spacing * right[1], -spacing * up[1], centre[1] - middle * spacing * (right[1] - up[1])],
                [0.0, 0.0, 1.0],
            ]
        )

    def place(self, points: NDArray[Any]) -> NDArray[np.float64]:
        """Return where scene points (n, 2) lie in the picture, as (column, row)."""
        inverse = np.linalg.inv(self.to_ground)
        return np.asarray(points @ inverse[:2, :2].T + inverse[:2, 2])

    def of_pixels(self, ground_to_pixel: NDArray[Any], points: NDArray[Any]) -> NDArray[np.float64]:
        """Return where a view's pixels (n, 2) lie in the picture."""
        back = np.linalg.inv(ground_to_pixel)
        return self.place(points @ back[:2, :2].T + back[:2, 2])

    def cut(
        self, ground_to_pixel: NDArray[Any], pixels: NDArray[np.uint8], beyond: int = 0
    ) -> NDArray[np.uint8]:
        """Cut it out of a picture; `beyond` where that has nothing."""
        onto = (ground_to_pixel @ self.to_ground)[:2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        border = (beyond,) * 4
        return np.asarray(
            cv2.warpAffine(pixels, onto, (self.pixels, self.pixels), flags=flags, borderValue=border)
        )


def grey(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return amplitude codes as greys."""
    db = LOW_DB + STEP_DB * (levels.astype(np.float32) - 1.0)
    share = (db - LOW_SHOWN_DB) / (HIGH_SHOWN_DB - LOW_SHOWN_DB)
    return np.asarray(255 * np.clip(share, 0, 1), np.uint8)


def grey_of(window: Window, entry: Entry, kind: str, unknown: int = 0) -> NDArray[np.uint8]:
    """Return a view as greys in a window; of amplitudes, `unknown` is the grey of what no sonar has seen."""
    onto, pixels = entry.info.camera.ground_to_pixel, entry.load()
    cut = window.cut(onto, pixels)
    if kind != "amplitude":
        return cut
    # A pixel that leans on one that is not known is none either: it would look like shadow.
    known = window.cut(onto, np.where(pixels > 0, np.uint8(255), np.uint8(0))) == 255
    return np.where(known, grey(cut), np.uint8(unknown))


def colours_of(window: Window, store: ViewStore, unknown: int = 0) -> NDArray[np.uint8]:
    """Return the colours by aspect in a window; `unknown` is the grey of what no sonar has seen."""
    info, _, pixels = store.pictures["color_by_aspect"]
    onto = info.grid.ground_to_pixel
    cut = window.cut(onto, pixels, unknown)
    # Black is what was not seen, and what is very dark; the levels tell the two apart.
    levels = store.pictures["multilook"][2] if "multilook" in store.pictures else None
    if levels is None or levels.shape != pixels.shape[:2]:
        return cut
    known = window.cut(onto, np.where(levels > 0, np.uint8(255), np.uint8(0))) == 255
    return np.where(known[..., None], cut, np.uint8(unknown))


def outlines(store: ViewStore, stamp_ns: int, window: Window) -> list[NDArray[np.float64]]:
    """Return the outlines of a view's segmented shadow in a window; none where there is no mask."""
    entry = store.sets["shadow_mask"].get(stamp_ns)
    if entry is None:
        return []
    lines = (np.reshape(line, (-1, 2)) for line in codes.contour(entry.load()))
    return [window.of_pixels(entry.info.camera.ground_to_pixel, line) for line in lines]


def cast(mesh: trimesh.Trimesh, info: ViewInfo, window: Window) -> list[NDArray[np.float64]]:
    """Return the outlines of the shadow that a surface casts in a view."""
    uv = window.of_pixels(info.camera.ground_to_pixel, info.camera.project(np.asarray(mesh.vertices)))
    dark = np.zeros((window.pixels, window.pixels), np.uint8)
    for triangle in np.rint(uv[mesh.faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(dark, triangle, 1, shift=4)
    found, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [line[:, 0].astype(np.float64) for line in found if len(line) >= 3]


def to_north(north_deg: float) -> tuple[float, float]:
    """Return the scene's direction of true north, which lies so many degrees counter-clockwise from +y."""
    north = math.radians(north_deg)
    return -math.sin(north), math.cos(north)


def moving_picture(store: ViewStore, name: str = "shadow", contact: str = "") -> bytes:
    """Make a GIF of the circle round a contact, north up: each view with where the sonar is.

    Parameters
    ----------
    store : ViewStore
        What is shown.
    name : str
        Which set of views.
    contact : str
        Which contact; the first by default.

    Raises
    ------
    ViewerError
        If there are no such views, or no such contact.
    """
    if name not in SETS or not store.sets.get(name):
        raise ViewerError(f"there are no views {name[:40]!r}")
    about, font = contact_named(store, contact), ImageFont.load_default(14)
    views = sorted(store.sets[name].values(), key=lambda e: e.info.aspect_rad % math.tau)
    views = views[:: math.ceil(len(views) / _FRAMES)]
    reach = 1.15 * (about["size_m"] / 2 + max(shadow_m(e.info, about) for e in views))
    room = 22
    north = north_shown_deg(store.scene())
    window = Window(about["position_m"], 2 * reach, to_north(north), _GIF_PX - 2 * room)
    radius, middle = window.pixels / 2, _GIF_PX / 2
    rows, cols = np.ogrid[: window.pixels, : window.pixels]
    inside = (rows - radius + 0.5) ** 2 + (cols - radius + 0.5) ** 2 < (radius - 1) ** 2
    frames = []
    greys = [(v, v, v) for v in np.linspace(0, 255, _GREYS).round().astype(int).tolist()]
    palette = Image.new("P", (1, 1))
    palette.putpalette([v for colour in (*greys, _GREEN, _AMBER, _RING, _BACKGROUND) for v in colour])
    for entry in views:
        picture = Image.fromarray(grey_of(window, entry, SETS[name])).convert("RGB")
        draw = ImageDraw.Draw(picture)
        for line in outlines(store, entry.info.stamp_ns, window):
            draw.line([*(tuple(p) for p in line.tolist()), tuple(line[0].tolist())], fill=_AMBER, width=2)
        frame = Image.new("RGB", (_GIF_PX, _GIF_PX), _BACKGROUND)
        frame.paste(picture, (room, room), Image.fromarray(inside))
        draw = ImageDraw.Draw(frame)
        ring = radius + 8
        draw.ellipse((middle - ring, middle - ring, middle + ring, middle + ring), outline=_RING, width=4)
        aspect = entry.info.aspect_rad
        at = aspect - math.radians(north)
        x, y = middle + ring * math.cos(at), middle - ring * math.sin(at)
        draw.ellipse((x - 9, y - 9, x + 9, y + 9), fill=_GREEN)
        bearing = round(90.0 + north - math.degrees(aspect)) % 360
        draw.text((6, _GIF_PX - 20), f"sonar bears {bearing:03d}°", fill="white", font=font)
        draw.text((6, 4), store.title, fill="white", font=font)
        bar = _round_length(reach / 2) / window.side_m * window.pixels
        draw.line((_GIF_PX - 8 - bar, _GIF_PX - 8, _GIF_PX - 8, _GIF_PX - 8), fill="white", width=3)
        told = f"{_round_length(reach / 2):g} m"
        draw.text((_GIF_PX - 8, _GIF_PX - 12), told, fill="white", font=font, anchor="rb")
        frames.append(frame.quantize(palette=palette, dither=Image.Dither.NONE))
    out = io.BytesIO()
    options: dict[str, Any] = {"duration": round(1000 / _FRAMES_PER_S), "loop": 0}
    frames[0].save(out, "GIF", save_all=True, append_images=frames[1:], **options)
    return out.getvalue()


def _round_length(goal_m: float) -> float:
    """Return the roundest length up to one."""
    ten = 10.0 ** math.floor(math.log10(goal_m))
    return next(m * ten for m in (5.0, 2.0, 1.0) if m * ten <= goal_m)


__all__ = [
    "Window",
    "cast",
    "colours_of",
    "contact_named",
    "grey_of",
    "moving_picture",
    "outlines",
    "shadow_m",
    "to_north",
]
