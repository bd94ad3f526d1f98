"""The carving methods: what each takes, adds and calls object, and how readers are told of it.

This table is the one place that tells methods apart: the parameter's choices, carver, threshold, figures and
the table of ``docs/method.md`` follow it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from .errors import ParameterError, quoted

Method = Literal["consensus", "hard", "soft"]


@dataclass(frozen=True)
class CarvingMethod:
    """One way to carve.

    Parameters
    ----------
    name : str
        One of `Method`.
    takes : {'shadow_mask', 'likelihood'}
        The stage whose views it integrates. Of a mask a view adds 1 to a voxel whose shadow pixel contradicts
        it, of a likelihood the pixel's value; both as whole numbers.
    other : str
        The method whose grid is made beside this one's.
    under : float or None
        A voxel is object if the mean of what its views add is under this; None: between the darkest and the
        brightest voxels, at `level`.
    level : float
        Where, from 0 (darkest) to 1 (brightest).
    support : float
        A voxel under the object is part of it unless its mean is over this, and over the threshold.
    least_views : float
        At most this fraction of the views must know a voxel for it to be free. To be object, as many must
        know it as `min_views_fraction` says, or it must stand on some.
    looks_twice : bool
        Whether the silhouettes are kept, and carve again once the shape tells which pixels its echo covers.
    adds, object_where : str
        The same in words, for ``docs/method.md``.
    title, says : str
        How figures call its surface, and what its grid holds.
    """

    name: Method
    takes: Literal["shadow_mask", "likelihood"]
    other: Method
    under: float | None
    adds: str
    object_where: str
    title: str
    says: str
    level: float = 0.0
    support: float = 0.0
    least_views: float = 1.0
    looks_twice: bool = False

    @property
    def takes_masks(self) -> bool:
        """Whether it carves with segmented silhouettes rather than likelihoods."""
        return self.takes == "shadow_mask"


_CONTRADICT = "fraction of views that contradict"

#: By name, the default first.
METHODS: dict[str, CarvingMethod] = {
    method.name: method
    for method in (
        CarvingMethod(
            "consensus",
            "shadow_mask",
            other="soft",
            # A voxel is removed when more than this fraction of its views contradict it. A voxel 2 cm off the
            # middle of a flat side of 0.8 m is seen to be free from 3 % of the circle; less tolerance loses
            # voxels to bad silhouettes, more leaves a skirt round flat sides.
            under=0.03,
            least_views=0.04,
            looks_twice=True,
            adds="1 if the voxel's shadow pixel is outside the silhouette, 0 if inside",
            object_where="under 3 % of its views contradict, after a second look",
            title="consensus of segmented shadows",
            says=_CONTRADICT,
        ),
        CarvingMethod(
            "hard",
            "shadow_mask",
            other="soft",
            # Any contradiction removes; the least one, 1 of 65535 views, is above this.
            under=1e-5,
            adds="the same",
            object_where="no view contradicts (the paper's 4.1)",
            title="space carving on segmented shadows",
            says=_CONTRADICT,
        ),
        CarvingMethod(
            "soft",
            "likelihood",
            other="hard",
            under=None,
            # A voxel just outside the object is bright in some views only: those that look past its side.
            level=0.115,
            # Masks say "unknown" where the target's echo lies, so that for them only unknown voxels need
            # filling; likelihoods say little there.
            support=0.35,
            adds="l_out of the pixel",
            object_where="the mean is under the threshold (the paper's 4.2)",
            title="soft space carving",
            says="mean likelihood of lying outside the shadow",
        ),
    )
}


def method_named(name: object) -> CarvingMethod:
    """Return a carving method.

    Raises
    ------
    ParameterError
        If there is none of that name; the message names all.
    """
    if not isinstance(name, str) or name not in METHODS:
        raise ParameterError(f"method is {quoted(name)}; expected one of: {', '.join(get_args(Method))}")
    return METHODS[name]


def names_that_take(stage: str) -> str:
    """Name the methods that take views of a stage, for errors."""
    return " or ".join(name for name, method in METHODS.items() if method.takes == stage)
