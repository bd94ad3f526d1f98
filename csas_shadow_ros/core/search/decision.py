"""What to carve: the one decision of every run, whatever its input."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from ..errors import NoTargetError, ViewError, check_range
from ..geometry import (
    TWO_PI,
    CoherentImage,
    Track,
    View,
    ViewInfo,
    fit_target_to_focus,
    place_text,
    wrap_angle,
)
from ..imaging.enhancement import enhance
from ..imaging.subaperture import Spectrum
from ..parameters import (
    MAX_OBJECTS,
    MOST_OBJECTS,
    PipelineParameters,
    ShadowParameters,
    TargetParameters,
)
from ..shape.result import Detectable, LeftOut
from ..shape.volume import Target
from .bodies import Search, SignEvidence, search_image, search_views, spectrum_sign_evidence
from .detectable import detectable_of

#: How many views from all round look for the target: one every 10°, as the search in an image makes them.
_SEARCH_VIEWS = 36
#: Further bodies take views so far apart (share of the aperture): two of them share three quarters of their
#: data. Of seven scenes of the development half with several bodies, at steps of 1°, no body's IoU with
#: its hull changes by more than 0.01 against all views; at double one loses 0.30 and one 0.08.
_OTHERS_APART = 0.25
#: An aspect is one of those if it is this near to it (rad): far below the least step, 0.1°.
_SAME_ASPECT_RAD = 1e-4
PHANTOM = "a phantom: shadows of other bodies cross over it, and it does not reach down to the seabed"


@dataclass(frozen=True)
class Decision:
    """What to carve in a scene.

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
    frame : str or None
        Name of the scene frame that places are in; None: that of the views, whichever it is.
    detectable : Detectable or None
        Where the search found nothing: what it would have found.
    others_step_rad : float
        Further bodies take the views whose aspects are multiples of it; 0: all views.
    """

    target: Target | None
    others: tuple[Target, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    sign: SignEvidence | None = None
    frame: str | None = None
    detectable: Detectable | None = None
    others_step_rad: float = 0.0

    def bodies_of(self, view: ViewInfo, stage: str) -> tuple[Target | None, ...]:
        """Return the bodies that take a view of a stage: the target, and of sub-apertures the others."""
        step = self.others_step_rad
        off = abs(math.remainder(view.aspect_rad, step)) if step else 0.0
        further = stage == "sub_aperture" and off < _SAME_ASPECT_RAD
        return (self.target, *(self.others if further else ()))

    def require_frame(self, view: ViewInfo) -> None:
        """Refuse a view in another frame.

        Raises
        ------
        ViewError
            Naming both frames.
        """
        if self.frame is not None and view.frame != self.frame:
            raise ViewError(
                f"view stamped {view.stamp_ns} ns is in frame {view.frame!r}; expected that of the target,"
                f" {self.frame!r}"
            )

    def same_target(self, other: Decision) -> bool:
        """Say whether views for one decision serve the other, with the same volumes."""
        return [_place(t) for t in (self.target, *self.others)] == [
            _place(t) for t in (other.target, *other.others)
        ]


def _place(target: Target | None) -> object:
    return None if target is None else (target.position_m, target.size_m)


def decide(
    search: Search | None,
    parameters: TargetParameters,
    sign: SignEvidence | None = None,
    max_objects: int = MAX_OBJECTS,
    beyond: str = "no more than {max_objects} bodies are carved",
) -> Decision:
    """Choose among the bodies that a search found.

    Parameters
    ----------
    search : Search or None
        None: nothing was looked at.
    parameters : TargetParameters
        ``auto``: the most evident body is the target, and what else stands on the seabed is carved too.
        ``given``: the one at that position is, alone; with its size given it need not be found.
    sign : SignEvidence, optional
        Whether the shadows fit the stated spectrum sign.
    max_objects : int
        At most so many bodies are carved, the target among them.
    beyond : str
        Why no more are.

    Raises
    ------
    SpectrumSignError
        If the shadows contradict the stated spectrum sign.
    NoTargetError
        If a position is given, its volume's size is automatic, and no body is there.
    ParameterError
        If `max_objects` is out of range.
    """
    check_range("max_objects", max_objects, 1, MOST_OBJECTS)
    if sign is not None:
        sign.check()
    p, found = parameters, search.targets if search is not None else ()
    if p.target == "given":
        return Decision(_given(found, p), sign=sign)
    doubted = search.left_out if search is not None else ()
    if not found:
        detectable = None  # where something may be an object the verdict is open as it is
        if search is not None and not any(left.strong for left in doubted):
            detectable = detectable_of(search)
        return Decision(None, left_out=doubted, sign=sign, detectable=detectable)
    others: list[Target] = []
    left_out = list(doubted)
    for body in found[1:]:
        if not body.stands:
            left_out.append(LeftOut(body.position_m, PHANTOM))
        elif len(others) + 1 >= max_objects:
            left_out.append(LeftOut(body.position_m, beyond.format(max_objects=max_objects)))
        else:
            others.append(body)
    return Decision(_sized(found[0], p), tuple(others), tuple(left_out), sign)


def _given(found: Iterable[Target], p: TargetParameters) -> Target:
    position = (p.position_m[0], p.position_m[1])
    here = [t for t in found if t.covers(position)]
    if here:
        return _sized(replace(here[0], position_m=position), p)
    if all(s > 0 for s in p.size_m):
        return Target(position, (p.size_m[0], p.size_m[1], p.size_m[2]))
    raise NoTargetError(
        f"no object at the given position ({position[0]:g}, {position[1]:g}) m;"
        " expected one, or size_m given too"
    )


def _sized(target: Target, p: TargetParameters) -> Target:
    size = tuple(given or auto for given, auto in zip(p.size_m, target.size_m, strict=True))
    return replace(target, size_m=(size[0], size[1], size[2]))


def decide_by_image(
    image: CoherentImage,
    track: Track,
    parameters: PipelineParameters,
    *,
    spectrum: Spectrum,
    max_objects: int = MAX_OBJECTS,
) -> Decision:
    """Decide by the full-circle image, or by the part that the track covers.

    `parameters.sub_aperture.check_sign` says whether the spectrum's sign is checked. Errors: see `decide`.
    """
    p, views = parameters.target, parameters.sub_aperture
    sign, search = None, None
    if views.check_sign:
        sign, search = spectrum_sign_evidence(image, track, spectrum=spectrum)
    elif not (p.target == "given" and all(s > 0 for s in p.size_m)):
        search = search_image(image, track, spectrum)
    every = max(1, math.floor(_OTHERS_APART * views.aperture_deg / views.step_deg + 1e-9))
    decision = decide(search, p, sign, max_objects)
    return replace(decision, others_step_rad=every * math.radians(views.step_deg))


def decide_by_views(
    views: Callable[[], Iterable[View]],
    stage: str,
    parameters: TargetParameters | None = None,
    max_objects: int = MAX_OBJECTS,
) -> Decision:
    """Decide by views of a stage.

    Parameters
    ----------
    views : callable
        Gives the views from the beginning, each time that it is called.
    stage : str
        ``sub_aperture`` or ``shadow``; likelihoods and masks do not tell where the target is.
    parameters : TargetParameters
        Position and size, or automatic.
    max_objects : int
        At most so many bodies are carved; of ``shadow`` views one, on which they are focused.

    Raises
    ------
    NoTargetError
        If there is no view, nothing is at the given position, or the stage's views (likelihood, mask) cannot
        tell where the target is and it is not given whole.
    """
    p = parameters or TargetParameters()
    if p.target == "given" and all(s > 0 for s in p.size_m):
        return decide(None, p)
    chosen = spread_views(views(), _SEARCH_VIEWS)
    if stage in ("likelihood", "shadow_mask"):
        try:
            focus = fit_target_to_focus([view.info for view in chosen])
            hint = f" (its views were focused on {place_text(focus)})"
        except ValueError:
            hint = ""
        raise NoTargetError(
            f"{stage} views do not tell how large the target is; expected target: given with position_m and"
            f" size_m{hint}"
        )
    unfocused = ShadowParameters(enhancement="none")
    amplitudes = []
    for view in chosen:
        try:
            amplitudes.append(enhance(view, (0.0, 0.0), unfocused) if stage == "sub_aperture" else view)
        except ViewError:
            continue  # named again, with its aspect, when it should be carved with
    search = search_views(amplitudes)
    if stage == "shadow":
        return decide(search, p, None, 1, "shadow views are focused on the target alone")
    return decide(search, p, None, max_objects)


def spread_views(views: Iterable[View], count: int, start_rad: float = 0.0) -> list[View]:
    """Keep the views nearest to `count` aspects round the circle, each once; memory holds no more.

    Parameters
    ----------
    views : iterable of View
        Any number, in any order.
    count : int
        Number of aspects.
    start_rad : float
        The first of them; the others follow every 2π/count.
    """
    kept: list[tuple[float, View] | None] = [None] * count
    step = TWO_PI / count
    for view in views:
        aspect = view.info.aspect_rad - start_rad
        slot = round((aspect % TWO_PI) / step) % count
        off = abs(float(wrap_angle(aspect - slot * step)))
        best = kept[slot]
        if best is None or off < best[0]:
            kept[slot] = (off, view)
    return [best[1] for best in kept if best is not None]
