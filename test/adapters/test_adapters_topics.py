"""The contract: names with and without a prefix, and which topics stay."""

from __future__ import annotations

import numpy as np
import pytest

from csas_shadow_ros.core.shape.volume import Volume
from msg_adapters import (
    LATCHED,
    STREAMS,
    TOPICS,
    VOXEL_STREAMS,
    AdapterError,
    is_latched,
    object_prefix,
    prefixed,
    split_prefix,
    stream,
    topic,
    voxel_grid_from_msgs,
    voxel_grid_to_msgs,
)
from msg_adapters.topics import PREFIXED_STREAMS, PREFIXED_TOPICS, topic_table

PREFIXES = ("object_2", "object_9", "object_10", "object_64", "other_method")


@pytest.mark.parametrize("prefix", PREFIXES)
def test_a_topic_under_a_prefix_is_the_one_without_it_but_for_its_name(prefix):
    for name in PREFIXED_TOPICS:
        whole = prefixed(prefix, name)
        assert split_prefix(whole) == (prefix, name)
        found = topic(whole)
        assert (found.name, found.type_name) == (whole, TOPICS[name].type_name)
        assert found.encodings == TOPICS[name].encodings
        assert is_latched(whole)
    for name in PREFIXED_STREAMS:
        found = stream(f"{prefix}/{name}")
        assert found.image_topic == f"{prefix}/{name}/image"
        assert found.info_topic == f"{prefix}/{name}/camera_info"
        assert found.content == STREAMS[name].content


def test_names_without_a_prefix_are_as_the_tables_say():
    for name, found in TOPICS.items():
        assert topic(name) is found
        assert split_prefix(name) == ("", name)
        assert prefixed("", name) == name
    for name, found in STREAMS.items():
        assert stream(name) is found


@pytest.mark.parametrize(
    "name",
    [
        "object_1/mesh",
        "object_65/mesh",
        "object_02/mesh",
        "object_2",
        "object_2/track",
        "other/mesh",
        "object_2/",
    ],
)
def test_a_topic_that_the_contract_does_not_have_is_refused_with_those_it_has(name):
    with pytest.raises(
        AdapterError, match=rf"there is no topic '{name}'; expected one of: image, .*voxels, mesh"
    ):
        topic(name)
    assert not is_latched(name)


def test_a_stream_that_the_contract_does_not_have_is_refused():
    for name in ("object_2/matter", "object_1/voxel_grid", "voxel"):
        with pytest.raises(
            AdapterError, match=rf"there is no image stream '{name}'; expected one of: image, "
        ):
            stream(name)


def test_a_prefix_that_there_is_not_is_not_put_before_a_name():
    with pytest.raises(
        AdapterError, match=r"prefix is 'object_1'; expected object_2 to object_64, or other_m"
    ):
        prefixed("object_1", "mesh")
    with pytest.raises(
        AdapterError, match=r"'track' does not exist under object_2; expected one of: voxel_grid"
    ):
        prefixed("object_2", "track")
    with pytest.raises(AdapterError, match="object number is 65; expected 1 to 64"):
        object_prefix(65)
    assert (object_prefix(1), object_prefix(2)) == ("", "object_2")


def test_what_is_latched_is_of_the_contract_and_views_are_not():
    assert set(TOPICS) >= LATCHED
    assert {
        "objects",
        "measurements",
        "evidence",
        "search",
        "matter/image",
        "matter/mesh",
        "track",
    } <= LATCHED
    assert not any(is_latched(n) for n in ("shadow/image", "sector/image", "progress", "/diagnostics"))


def test_the_table_has_a_row_a_topic_and_one_a_family_of_prefixes():
    rows = topic_table().splitlines()[2:]
    assert len(rows) == len(TOPICS) + 2
    assert "`object_N/voxel_grid/*`, `object_N/voxel_views/*`, `object_N/voxels`, `object_N/mesh`" in rows[-2]
    assert "`other_method/mesh`" in rows[-1]


@pytest.mark.parametrize("name", [*VOXEL_STREAMS, "object_7/voxel_grid", "other_method/voxel_views"])
def test_voxels_of_every_stream_survive_the_round_trip_in_place(factory, name):
    volume = Volume((-0.5, 1.25, 0.25), 0.5, (3, 4, 5))
    rng = np.random.default_rng(0)
    values = rng.random(volume.shape, dtype=np.float32)
    if name == "matter":
        values = values < 0.5
    elif stream(name).content == "count":
        values = rng.integers(0, 361, volume.shape).astype(np.uint16)
    image, info = voxel_grid_to_msgs(factory, volume, values, 42, name)
    assert image.encoding == ("8UC3" if name == "matter" else "32FC3")
    stamp, lattice, back = voxel_grid_from_msgs(image, info, name)
    assert (stamp, lattice) == (42, volume)
    np.testing.assert_array_equal(back, values)


def test_matter_is_255_at_its_voxels_rows_north_up(factory):
    volume = Volume((0.0, 0.0, 0.25), 0.5, (2, 3, 4))
    matter = np.zeros(volume.shape, bool)
    matter[1, 0, 2] = True  # the upper layer, the smallest y
    image, _ = voxel_grid_to_msgs(factory, volume, matter, 42, "matter")
    assert np.flatnonzero(np.asarray(image.data)).tolist() == [(2 * 4 + 2) * 2 + 1]
    assert set(image.data) == {0, 255}


def test_matter_that_is_neither_0_nor_255_is_refused_and_so_is_another_encoding(factory):
    volume = Volume((0.0, 0.0, 0.25), 0.5, (2, 3, 4))
    image, info = voxel_grid_to_msgs(factory, volume, np.zeros(volume.shape, bool), 42, "matter")
    raw = np.asarray(image.data, np.uint8).copy()
    raw[5] = 128
    image.data = factory.octets(raw)
    with pytest.raises(
        AdapterError,
        match=r"matter/image has 1 of 24 pixels neither 0 nor 255, the first at row 0, column 2, channel 1",
    ):
        voxel_grid_from_msgs(image, info, "matter")
    image.encoding = "32FC2"
    with pytest.raises(AdapterError, match=r"matter/image\.encoding is '32FC2'; expected one of: 8UCn"):
        voxel_grid_from_msgs(image, info, "matter")
