"""Right messages of every type, damaged by seeds: each is read, or refused in one short line.

`CSAS_BAD_MESSAGES=1000` tries so many of them; 200 without it.
"""

from __future__ import annotations

import math
import os
import random
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import trimesh

import msg_adapters as m
from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.shape.result import Result, ViewEvidence
from csas_shadow_ros.core.shape.volume import Target, Volume
from msg_adapters.messages import typestore

CASES = int(os.environ.get("CSAS_BAD_MESSAGES", "200"))
MOST_CHARACTERS = 300
FACTORY = m.RosbagsMessages()
STAMP_NS = 1_700_000_000_123_456_789
ACOUSTICS = Acoustics(120e3, 40e3, 1500.0, -1)

NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1.5, 1e-300, 5e-324, 1000.0, 1e9, 1e300, -1e300)
WHOLE = (0, 1, 2, 3, 7, 11, 255, 65_536, 2**31 - 1, 2**31, 2**32 - 1, -1, -(2**31))
LONG = "x" * 1_000_000
TEXTS = ("", LONG, "\n\x00\x1b[31m" * 50, "map", "csas_scene", "csas_shadow", "csas_image")
TEXTS += ("32FC1", "32FC2", "16SC2", "mono8", "mono16", "32FC99999", "8UC4", "32fc2")
TEXTS += ("nan", "inf", "1e400", "9" * 5000, "-1", "1.5", "true", "run", "object 1", "heartbeat")
TEXTS += ("rejected: ", "matter")


def speckle(rows: int, cols: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return (rng.standard_normal((rows, cols)) + 1j * rng.standard_normal((rows, cols))).astype(np.complex64)


def a_view(stream: str) -> View:
    sonar = (75 * math.cos(1.7), 75 * math.sin(1.7), 18.0)
    camera = ShadowCamera.from_ground(view_ground_to_pixel(1.7, 0.04, 9, 14, (0.3, -0.2)), sonar, 9, 14)
    focus = math.nan if stream == "sub_aperture" else 2.5
    info = ViewInfo(STAMP_NS, camera, ACOUSTICS, 1.7, 0.2, (-50.0, 900.0), focus)
    amplitude = np.abs(speckle(9, 14))
    pixels = {"sub_aperture": speckle(9, 14), "shadow": amplitude, "likelihood": amplitude / amplitude.max()}
    return View(info, pixels.get(stream, (amplitude > 1).astype(np.uint8) * 255))


@lru_cache(maxsize=1)
def samples() -> dict[str, tuple[list[Any], Callable[..., Any]]]:
    """Return, by name, right messages and what reads them together."""
    grid = GroundGrid.centred(12, 17, 0.02, (1.5, -2.25))
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    circle = np.c_[75 * np.cos(angle), 75 * np.sin(angle), np.full(120, 18.0)]
    track = Track(STAMP_NS + np.arange(120) * 500_000_001, circle)
    volume = Volume.around((0.1, -0.2), (0.5, 0.4, 0.3), 0.1)
    levels = np.random.default_rng(1).random(volume.shape, dtype=np.float32)
    target = Target((0.1, -0.2), (0.5, 0.4, 0.3))
    view = m.ViewProgress.rejected(STAMP_NS, "voxel_carver", "1f", "it is too dark")
    beat = m.Heartbeat(STAMP_NS, "voxel_carver", "1f", "sink", {"in": 3, "out": 2}, {"input": "shadow"})
    composite = m.GroundInfo(STAMP_NS, grid, ACOUSTICS)
    evidence = {STAMP_NS: ViewEvidence(STAMP_NS, 0.3, (1.0, 2.0, 3.0), 0.7, 9.0, True, 0.4)}
    result = Result(stamp_ns=STAMP_NS, verdict="no object", target=target, evidence=evidence)
    path = m.track_to_msg(FACTORY, track)
    made: dict[str, tuple[Any, Callable[..., Any]]] = {
        "image": (
            m.coherent_image_to_msgs(FACTORY, CoherentImage(speckle(12, 17), grid, ACOUSTICS, STAMP_NS)),
            m.coherent_image_from_msgs,
        ),
        "sector": (
            m.sector_to_msgs(
                FACTORY, Sector(speckle(12, 17), grid, ACOUSTICS, STAMP_NS, 0.3, 0.1, (400.0, -120.0))
            ),
            m.sector_from_msgs,
        ),
        "multilook": (
            m.ground_picture_to_msgs(FACTORY, np.abs(speckle(12, 17)), composite, "multilook"),
            lambda a, b: m.ground_picture_from_msgs(a, b, "multilook"),
        ),
        "voxel_grid": (m.voxel_grid_to_msgs(FACTORY, volume, levels, STAMP_NS), m.voxel_grid_from_msgs),
        "track": ((path,), m.track_piece_from_msg),
        "whole track": ((path,), m.track_from_msg),
        "mesh": ((m.mesh_to_msg(FACTORY, trimesh.creation.box(), STAMP_NS),), m.mesh_from_msg),
        "target": (
            (m.target_to_msg(FACTORY, m.TargetBox((0.1, -0.2, 0.15), (0.5, 0.4, 0.3)), STAMP_NS),),
            m.target_from_msg,
        ),
        "search": (
            (m.decision_to_msg(FACTORY, Decision(target), STAMP_NS, STAMP_NS, STAMP_NS),),
            m.decision_from_msg,
        ),
        "measurements": ((m.measurements_to_msg(FACTORY, result),), m.measurements_from_msg),
        "evidence": ((m.evidence_to_msg(FACTORY, evidence, STAMP_NS),), m.evidence_from_msg),
        "rejected view": ((m.progress_to_msg(FACTORY, view),), m.progress_from_msg),
        "heartbeat": ((m.progress_to_msg(FACTORY, beat),), m.progress_from_msg),
    }
    for stream in m.VIEW_STREAMS:
        made[stream] = (
            m.view_to_msgs(FACTORY, a_view(stream), stream),
            lambda a, b, stream=stream: m.view_from_msgs(a, b, stream),
        )
    return {name: (list(messages), read) for name, (messages, read) in made.items()}


def places(message: Any) -> list[tuple[Any, str]]:
    """Return every field of a message and of all that it holds, as (holder, name)."""
    found = []
    for one in fields(message):
        if one.name == "__msgtype__":
            continue
        value = getattr(message, one.name)
        found.append((message, one.name))
        for inner in value if isinstance(value, list) else [value]:
            if is_dataclass(inner):
                found += places(inner)
    return found


def another(value: Any, random: random.Random) -> Any:
    """Return something of the same kind in a field's place."""
    if isinstance(value, str):
        return random.choice(TEXTS)
    if isinstance(value, bool | int):
        return random.choice(WHOLE)
    if isinstance(value, float):
        return random.choice(NUMBERS)
    if isinstance(value, list):
        kept = random.choice((0, 1, len(value) // 2, len(value)))
        return value[:kept] if random.random() < 0.5 else value + value[:kept]
    if isinstance(value, np.ndarray):
        changed = value.copy()
        if changed.dtype == np.uint8:
            # Pixels: bytes that are NaN, infinite or huge numbers, or a row too few or too many.
            raw = random.choice((b"\x00", b"\xff", b"\x7f", b"\x00\x00\xc0\x7f", b"\xff\xff\x7f\x7f"))
            at = random.randrange(max(1, changed.size - 16)) // 4 * 4
            count = random.choice((1, 4, changed.size))
            changed[at : at + count] = np.resize(np.frombuffer(raw, np.uint8), changed[at : at + count].size)
        elif changed.size:
            changed[random.randrange(changed.size)] = random.choice(NUMBERS)
        if random.random() < 0.3:
            changed = np.resize(changed, random.choice((0, 1, max(0, changed.size - 1), changed.size + 1)))
        return changed
    return value


def damaged(messages: list[Any], seed: int) -> list[str]:
    """Change one to three fields of messages; return which."""
    chance = random.Random(seed)
    told = []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        message = chance.choice(messages)
        if chance.random() < 0.05 and {"width", "height"} <= {f.name for f in fields(message)}:
            message.width, message.height = message.height, message.width
            told.append("width and height swapped")
            continue
        holder, name = chance.choice(places(message))
        setattr(holder, name, another(getattr(holder, name), chance))
        told.append(f"{type(holder).__name__}.{name}")
    return told


def own(messages: list[Any]) -> list[Any]:
    """Return copies that may be changed: through their bytes, as they come."""
    store = typestore()
    return [
        store.deserialize_cdr(bytes(store.serialize_cdr(one, one.__msgtype__)), one.__msgtype__)
        for one in messages
    ]


def is_one_short_line(text: str) -> bool:
    # Printable: no line breaks, and nothing that moves a terminal's cursor.
    return len(text) < MOST_CHARACTERS and text.isprintable()


def test_the_messages_are_right_before_they_are_damaged() -> None:
    for messages, read in samples().values():
        read(*messages)


@pytest.mark.parametrize("name", samples())
def test_a_damaged_message_is_read_or_refused_in_one_short_line(name: str) -> None:
    messages, read = samples()[name]
    for seed in range(math.ceil(CASES / len(samples()))):
        ours = own(messages)
        what = damaged(ours, seed)
        refused = "it was read"
        with warnings.catch_warnings():
            # numpy's warnings would go to a node's standard error.
            warnings.simplefilter("error")
            try:
                read(*ours)
            except CsasError as error:
                refused = str(error)
            except Exception as error:
                raise AssertionError(f"{name}, seed {seed}, {what}: {type(error).__name__}") from error
        assert is_one_short_line(refused), (name, seed, what, refused)


@pytest.mark.parametrize("name", samples())
def test_damaged_bytes_are_read_or_refused_in_one_short_line(name: str) -> None:
    messages, read = samples()[name]
    store = typestore()
    whole = [bytes(store.serialize_cdr(one, one.__msgtype__)) for one in messages]
    for seed in range(math.ceil(CASES / len(samples()))):
        chance = random.Random(seed)
        spoilt = [bytearray(one) for one in whole]
        victim = chance.choice(spoilt)
        for _ in range(chance.choice((1, 4, 30))):
            # The first bytes are lengths and stamps: they are what matters most.
            end = chance.choice((64, len(victim)))
            victim[chance.randrange(min(end, len(victim)))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
        if chance.random() < 0.3:
            del victim[chance.randrange(len(victim)) :]
        refused = "it was read"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                read(
                    *(
                        m.message_from_cdr(bytes(cdr), one.__msgtype__, name)
                        for cdr, one in zip(spoilt, messages, strict=True)
                    )
                )
            except CsasError as error:
                refused = str(error)
            except Exception as error:
                raise AssertionError(f"{name}, seed {seed}: {type(error).__name__}") from error
        assert is_one_short_line(refused), (name, seed, refused)


def test_a_long_value_is_cut_and_its_length_told() -> None:
    messages, read = samples()["image"]
    image, info = own(messages)
    with pytest.raises(m.AdapterError, match=r"encoding is 'x{40}'… \(1000000 characters\); expected one of"):
        read(replace(image, encoding=LONG), info)
    far = replace(image, header=replace(image.header, frame_id=LONG))
    with pytest.raises(m.AdapterError, match=r"frame_id is 'x{40}'… \(1000000 characters\); expected the"):
        read(far, info)
