"""The nodes of the package, in the order in which a graph starts them: all other lists are made of this.

Entry points, packaging, launch file, replay and checks take their names from here. It imports nothing beyond
Python's own library: setup.py reads it before anything is installed, and the launch file before ROS is.
``python -m csas_shadow_ros.node_table`` prints the names.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class NodeEntry:
    """One node: the module of its name in ``nodes/``, and its place in the graph.

    Parameters
    ----------
    name : str
        Of the node, its module and its executable.
    takes : tuple of str
        Streams whose views it works on; any of them will do.
    gives : tuple of str
        Streams of views that it makes of them.
    beside : bool
        Whether the run goes on to its end without it.
    source : bool
        Whether it sends views on its own account, and says when all are through.
    needed : str
        Why a replay cannot leave it out; empty: it can, as an outside node may take its place.
    """

    name: str
    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    beside: bool = False
    source: bool = False
    needed: str = ""


#: First those that have most to do before there is a view.
NODES = {
    node.name: node
    for node in (
        NodeEntry("bag_player", beside=True, source=True, needed="it plays the bag"),
        NodeEntry(
            "sub_aperture",
            ("image", "sector"),
            ("sub_aperture",),
            source=True,
            needed="it decides what is carved, and sends every view until all have it",
        ),
        NodeEntry("shadow_enhancement", ("sub_aperture",), ("shadow",)),
        NodeEntry("shadow_likelihood", ("shadow",), ("likelihood", "shadow_mask")),
        NodeEntry("voxel_carver", ("likelihood", "shadow_mask"), needed="its grid is the result"),
        NodeEntry("composites", ("sub_aperture",), beside=True),
        NodeEntry("bag_recorder", beside=True, needed="the results are made of its bag"),
        NodeEntry("viewer", beside=True, needed="only --view starts it"),
    )
}


#: What a replay can leave out.
REPLACEABLE = tuple(name for name, node in NODES.items() if not node.needed)


#: Who says when all views are through.
SOURCES = tuple(name for name, node in NODES.items() if node.source)


def chain(stream: str) -> tuple[str, ...]:
    """Name the nodes that lead from a stream to the grid, in order.

    Examples
    --------
    >>> chain("shadow")
    ('shadow_likelihood', 'voxel_carver')
    """
    there, found = {stream}, []
    for node in NODES.values():
        if not node.beside and there & set(node.takes):
            found.append(node.name)
            there |= set(node.gives)
    return tuple(found)


def makers(stream: str, first: str = "sub_aperture") -> tuple[str, ...]:
    """Name the nodes that a view passes, from one stream on, before it is in another.

    Examples
    --------
    >>> makers("likelihood")
    ('shadow_enhancement', 'shadow_likelihood')
    >>> makers("sub_aperture")
    ()
    """
    names = chain(first)
    last = next((n for n, name in enumerate(names) if stream in NODES[name].gives), -1)
    return names[: last + 1]


def joins(name: str, stream: str) -> bool:
    """Say whether what a node takes exists in a graph that is fed with a stream."""
    there = {stream, *(given for node in chain(stream) for given in NODES[node].gives)}
    return bool(there & set(NODES[name].takes))


if __name__ == "__main__":
    print(*NODES)
