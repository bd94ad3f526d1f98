"""TEMP."""
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from .track import Track
@dataclass(frozen=True, eq=False)
class TrackPiece:
    stamps_ns: object
    positions_m: object
    header_ns: int = 0
class TrackBook:
    def __init__(self):
        self.tracks = {}
        self.renamed = {}
    @property
    def names(self): return list(self.tracks)
    def add(self, piece):
        name = int(piece.stamps_ns[0])
        if name not in self.tracks or len(piece.stamps_ns) >= len(self.tracks[name]):
            self.tracks[name] = Track(piece.stamps_ns, piece.positions_m)
        return name
    def track(self, name): return self.tracks[name]
    def run_of(self, stamp):
        for n, t in reversed(self.tracks.items()):
            m = 3 * int(np.median(np.diff(t.stamps_ns)))
            if t.stamps_ns[0] - m <= stamp <= t.stamps_ns[-1] + m: return n
        return None
    def describe(self): return str(self.names)
