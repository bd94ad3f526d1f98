"""The node graph: its processes, and the replay of a bag through them."""

from .processes import Graph, start_fork_server

__all__ = ["Graph", "start_fork_server"]
