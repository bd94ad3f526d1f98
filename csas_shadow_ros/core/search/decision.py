"""What is to be carved: the one decision that every run takes, from whatever it has."""

from __future__ import annotations

from dataclasses import dataclass

from ..shape.result import LeftOut
from ..target import SignEvidence
from ..volume import Target


@dataclass(frozen=True)
class Decision:
    """What is to be carved in a scene.

    Parameters
    ----------
    target : Target or None
        The body that the run is about; None: there is none.
    others : tuple of Target
        Further bodies to carve, in order of evidence.
    left_out : tuple of LeftOut
        Bodies that the search found and that are not carved, and why.
    sign : SignEvidence or None
        Whether the shadows fit the stated spectrum sign; None if it was not checked.
    """

    target: Target | None
    others: tuple[Target, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    sign: SignEvidence | None = None
