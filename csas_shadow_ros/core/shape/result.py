"""The result of a run: plain data, the same for every source of views, on topics as in a results folder."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..equality import equal_where_nan
from ..geometry import SCENE_FRAME
from ..methods import method_named
from .mesh import Dimensions
from .volume import Target, VoxelGrid

if TYPE_CHECKING:
    import trimesh
    import xarray
    from matplotlib.figure import Figure

    from ..geometry import Datum, Place, View
    from ..imaging.composites import Composites
    from ..search.bodies import SignEvidence
    from ..search.decision import Decision
    from .hollows import EchoLook
    from .measurement import SilhouetteSides

#: What a run can find.
VERDICTS = ("object", "no object", "undecided")
#: How far its result can be trusted.
QUALITIES = ("good", "limited", "not trustworthy")


@dataclass(frozen=True)
class Quality:
    """How far a result can be trusted.

    Parameters
    ----------
    verdict : str
        One of `QUALITIES`.
    reasons : tuple of str
        Why it is not better; empty if it is good.
    """

    verdict: str = "good"
    reasons: tuple[str, ...] = ()


@equal_where_nan
@dataclass(frozen=True)
class ViewEvidence:
    """The contribution of one view.

    Parameters
    ----------
    stamp_ns : int
        The view.
    aspect_rad : float
        Where it looked from.
    sonar_m : (float, float, float)
        Position of the sonar, scene frame.
    seabed_level : float
        σ_r, the mode of the seabed's amplitude; NaN of a view of which only the silhouette came.
    contrast : float
        σ_r / σ_s; NaN likewise.
    levels_estimated : bool
        Whether the shadow's level was measured in the view (otherwise the contrast hypothesis).
    height_m : float
        Height that the length of its shadow implies; NaN where there is no shadow or no object.
    unexplained : float
        Share of its segmented shadow that the object's own lies clear of; NaN where nobody compared them.
    lit : float
        Share of the object's shadow that is lit seabed in the view; NaN likewise.
    shift_m : float
        How far along e_c it lay from its place before it was put back, m; 0 where it stayed as told.
    """

    stamp_ns: int
    aspect_rad: float
    sonar_m: tuple[float, float, float]
    seabed_level: float = math.nan
    contrast: float = math.nan
    levels_estimated: bool = False
    height_m: float = math.nan
    unexplained: float = math.nan
    lit: float = math.nan
    shift_m: float = 0.0


#: How a reason begins that doubts the image's spectrum sign, and with it whatever was carved.
OTHER_SIGN = "under the other spectrum_sign"


@dataclass(frozen=True)
class LeftOut:
    """A body that is not an object, or was not examined: its place (x, y) and the reason.

    Parameters
    ----------
    position_m : (float, float)
        Where it is.
    reason : str
        Why it is none.
    strong : bool
        Whether it may well be an object: where it is, "no object" cannot be said.
    """

    position_m: tuple[float, float]
    reason: str
    strong: bool = False


@dataclass(frozen=True)
class Detectable:
    """What a search that found nothing would have found: shadows put into its own views.

    Parameters
    ----------
    size_m : float
        How wide the body is.
    height_m : float
        How high it is.
    contrast_db : float
        How far its shadow lies under the seabed.
    found, places : int
        At how many places it was found, of how many.
    """

    size_m: float
    height_m: float
    contrast_db: float
    found: int
    places: int

    @property
    def is_enough(self) -> bool:
        """Whether it is found at all places but one: one may be a patch that hides it."""
        return self.found >= self.places - 1

    def __str__(self) -> str:
        return (
            f"a body {self.size_m:.2f} m wide and {self.height_m:.2f} m high with {self.contrast_db:g} dB of"
            f" contrast would have been found at {self.found} of {self.places} places"
        )


@dataclass(frozen=True, eq=False)
class ObjectResult:
    """One object of the scene.

    Parameters
    ----------
    target : Target
        The volume that was carved; for one of several pieces in a volume, the piece's part of it.
    grid : VoxelGrid
        By the chosen method; nothing is occupied but the object.
    mesh, dimensions : trimesh.Trimesh, Dimensions
        Surface and measures.
    views_used : int
        Views in the grid.
    """

    target: Target
    grid: VoxelGrid
    mesh: trimesh.Trimesh
    dimensions: Dimensions
    views_used: int

    def __repr__(self) -> str:
        return f"ObjectResult: {self.dimensions} ({self.views_used} views)"


@dataclass(eq=False)
class Result:
    """The result of a run.

    Attributes
    ----------
    run_ns : int or None
        The run's name: the stamp of its track's first pose; None where there is no track.
    stamp_ns : int
        Stamp of the newest view in it; 0 before the first.
    final : bool
        Whether no more views are to come.
    verdict : str
        One of `VERDICTS`.
    quality : Quality
        How far that can be trusted, and why not further.
    target : Target or None
        The volume that was carved; None: nothing was found to carve.
    decision : Decision or None
        Everything that was carved, the target among it.
    sign : SignEvidence or None
        Whether the shadows fit the spectrum sign; None if it was not checked.
    grid, other_grid : VoxelGrid or None
        By the chosen method, and by the other one (where it was asked for). Where silhouettes leave nothing
        and the mean likelihood of all views leaves an object, the grid is by that.
    mesh, dimensions : trimesh.Trimesh, Dimensions or None
        Surface and measures of the object.
    matter : ndarray of bool, shape (nz, ny, nx), or None
        The grid's object without the hollows that its echoes show; None where no echo was looked at.
    matter_mesh : trimesh.Trimesh or None
        Its surface: `mesh` itself where there is no hollow.
    composites : Composites or None
        Multi-look and colour-by-aspect images.
    views_used : int
        Views in the grid.
    views_lost : int
        Views that the graph could not get to whoever needs them: the grid is without them.
    arc_rad : float
        How much of the circle their apertures cover.
    rejected : dict
        Reason for each aspect (degrees) whose view was not used.
    evidence : dict of ViewEvidence
        What each view in the grid contributed, by stamp.
    sides : list of SilhouetteSides
        Where the shadow ends in each view: what the dimensions are measured on. Kept in the process that
        made the result; a result that was read from topics has none.
    looks : dict of EchoLook
        Where each view is dark round the target, by stamp: what hollows are told by. Kept likewise.
    best_shadow : View or None
        The view in which the target's shadow shows most: amplitude, or what the run started from. Kept
        likewise, where all views were processed in one go.
    further : list of ObjectResult
        What else stands on the seabed, in the order of the search's evidence.
    left_out : list of LeftOut
        Bodies of the search that are no objects, and why.
    detectable : Detectable or None
        Where the search found nothing: what it would have found.
    timings_s : dict
        Seconds of wall time by step.
    frame : str
        Name of the scene frame.
    datum : Datum or None
        Where on earth that frame's origin is; None: nobody said.
    """

    run_ns: int | None = None
    stamp_ns: int = 0
    final: bool = True
    verdict: str = "no object"
    quality: Quality = Quality()
    target: Target | None = None
    decision: Decision | None = None
    sign: SignEvidence | None = None
    grid: VoxelGrid | None = None
    other_grid: VoxelGrid | None = None
    mesh: trimesh.Trimesh | None = None
    dimensions: Dimensions | None = None
    matter: NDArray[np.bool_] | None = None
    matter_mesh: trimesh.Trimesh | None = None
    composites: Composites | None = None
    views_used: int = 0
    views_lost: int = 0
    arc_rad: float = 0.0
    rejected: dict[float, str] = field(default_factory=dict)
    evidence: dict[int, ViewEvidence] = field(default_factory=dict)
    sides: list[SilhouetteSides] = field(default_factory=list)
    looks: dict[int, EchoLook] = field(default_factory=dict)
    best_shadow: View | None = None
    further: list[ObjectResult] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    detectable: Detectable | None = None
    timings_s: dict[str, float] = field(default_factory=dict)
    frame: str = SCENE_FRAME
    datum: Datum | None = None

    def place_of(self, dimensions: Dimensions) -> Place | None:
        """Return an object's place on earth; None without a datum."""
        return None if self.datum is None else self.datum.place_of(dimensions)

    @property
    def by_likelihood_alone(self) -> bool:
        """Whether only the mean likelihood of all views shows the object, not silhouettes."""
        grid, other = self.grid, self.other_grid
        if grid is None or other is None or method_named(grid.method).takes_masks:
            return False
        return bool(grid.occupied.any()) and not other.occupied.any()

    @property
    def objects(self) -> list[ObjectResult]:
        """Every object, the target first (unless its carving left none)."""
        if self.target is None or self.grid is None or self.mesh is None or self.dimensions is None:
            return list(self.further)
        main = ObjectResult(self.target, self.grid, self.mesh, self.dimensions, self.views_used)
        return [main, *self.further]

    def __repr__(self) -> str:
        from .show import text  # late, as in the next ones: who only passes a result on draws nothing

        return text(self)

    def _repr_html_(self) -> str:
        from .show import as_html

        return as_html(self)

    def plot(self) -> Figure:
        """Draw the plan, the side, and the view with the most shadow (the sonar is above it).

        Returns
        -------
        matplotlib.figure.Figure
            A figure of its own, not one of pyplot's: a notebook shows it, `savefig` writes it.

        Examples
        --------
        >>> import csas_shadow_ros as csas
        >>> result = csas.reconstruct(csas.simulate("tiny"), csas.parameters(step_deg=15))
        >>> figure = result.plot()
        >>> figure.savefig("box.png")
        """
        from .picture import plot

        return plot(self)

    def to_xarray(self) -> xarray.Dataset:
        """Return the target's grid as labelled arrays over z, y and x (m, scene frame).

        Returns
        -------
        xarray.Dataset
            ``likelihood``, ``views``, ``occupied`` and ``matter``; verdict, quality and dimensions are its
            attributes. Without a grid it has these alone.

        Raises
        ------
        MissingExtraError
            If xarray is not installed: ``pip install 'csas_shadow_ros[xarray]'``.

        Examples
        --------
        >>> import csas_shadow_ros as csas
        >>> result = csas.reconstruct(csas.simulate("tiny"), csas.parameters(step_deg=15))
        >>> grid = result.to_xarray()
        >>> grid.occupied.dims
        ('z', 'y', 'x')
        >>> top = grid.occupied.any(["x", "y"])
        >>> 0.2 < float(grid.z[top].max()) < 0.6
        True
        """
        from .show import to_xarray

        return to_xarray(self)
