"""The node graph: its processes, and the replay of a bag through them."""

from .processes import DomainReservation, Graph, GraphProcess, graph_environment, start_fork_server

__all__ = ["DomainReservation", "Graph", "GraphProcess", "graph_environment", "start_fork_server"]
