"""What an operator decides: judgements, bookmarks and rulers, in one small file beside the results."""

from __future__ import annotations

import datetime
import json
import math
import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..core.errors import CsasError, ParameterError
from ..durable import locked, write_whole
from .store import ViewerError

FILE = "desk.json"
FORMAT = "csas_shadow_ros desk 1"
#: How a contact may be judged.
VERDICTS = ("mine-like", "not mine-like", "undecided")
#: A file of a thousand judgements with remarks has half of it; more is no operator's work.
MAX_BYTES = 1 << 20
#: Letters of a remark and of a name.
_REMARK, _NAME = 2000, 80
_ID = re.compile(r"[a-z][a-z0-9_-]{0,63}")


def _text(value: Any, what: str, most: int) -> str:
    if not isinstance(value, str) or len(value) > most or any(ord(c) < 32 and c not in "\n\t" for c in value):
        raise ParameterError(f"{what} is {str(value)[:40]!r}; expected text of at most {most} letters")
    return value


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ParameterError(f"{what} is {str(value)[:40]!r}; expected a number")
    return float(value)


def _stamp(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[0-9]{1,20}", value):
        raise ParameterError(f"stamp is {str(value)[:40]!r}; expected a view's stamp (ns)")
    return value


def _judgement(value: Mapping[str, Any]) -> dict[str, Any]:
    if value.get("verdict") not in VERDICTS:
        raise ParameterError(f"verdict is {str(value.get('verdict'))[:40]!r}; expected one of {VERDICTS}")
    return {
        "verdict": value["verdict"],
        "remark": _text(value.get("remark", ""), "remark", _REMARK),
        "operator": _text(value.get("operator", ""), "operator", _NAME),
    }


def _bookmark(value: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "aspect_deg": _number(value.get("aspect_deg"), "aspect_deg") % 360.0,
        "name": _text(value.get("name", ""), "name", _NAME),
    }


def _ruler(value: Mapping[str, Any]) -> dict[str, Any]:
    ends = value.get("ends")
    if (
        not isinstance(ends, list)
        or len(ends) != 2
        or not all(isinstance(e, list) and len(e) == 2 for e in ends)
    ):
        raise ParameterError(f"ends is {str(ends)[:40]!r}; expected two points (x, y), in metres")
    return {
        "aspect_deg": _number(value.get("aspect_deg"), "aspect_deg") % 360.0,
        "stamp": _stamp(value.get("stamp")),
        "ends": [[_number(v, "ends") for v in end] for end in ends],
        "name": _text(value.get("name", ""), "name", _NAME),
    }


_KINDS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "judgement": _judgement,
    "bookmark": _bookmark,
    "ruler": _ruler,
}


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


class Desk:
    """The file ``desk.json`` of a results folder.

    Items have a name, a kind and a revision. Whoever changes one says which revision it saw: if another has
    changed it since, that one's value is kept with the item (``earlier``), and what another has changed is
    not removed. So two who judge at once lose nothing.

    Parameters
    ----------
    folder : path-like
        A results folder.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as place:
    ...     desk = Desk(place)
    ...     judged = {"verdict": "undecided", "remark": "", "operator": "A"}
    ...     _ = desk.change([{"id": "object-1", "kind": "judgement", "base": 0, "value": judged}])
    ...     Desk(place).document()["items"]["object-1"]["value"]["verdict"]
    'undecided'
    """

    def __init__(self, folder: str | Path) -> None:
        self.path = Path(folder) / FILE
        self._lock = threading.Lock()

    def document(self) -> dict[str, Any]:
        """Read the file; what nobody has written yet is empty.

        Raises
        ------
        ViewerError
            If there is a file that is none, or of another version.
        """
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return {"format": FORMAT, "revision": 0, "items": {}}
        except (OSError, ValueError) as error:
            raise ViewerError(f"{self.path} cannot be read: {error}") from error
        try:
            found = json.loads(text)
            if found["format"] != FORMAT:
                raise ParameterError(f"format is {str(found['format'])[:40]!r}; expected {FORMAT!r}")
            items = {str(name): self._checked_item(str(name), item) for name, item in found["items"].items()}
            return {"format": FORMAT, "revision": int(found["revision"]), "items": items}
        except (CsasError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            why = str(error) if isinstance(error, CsasError) else f"it holds no {FORMAT!r}"
            raise ViewerError(f"{self.path} cannot be read: {why}") from error

    @staticmethod
    def _checked_item(name: str, item: Mapping[str, Any]) -> dict[str, Any]:
        kind = item["kind"]
        if not _ID.fullmatch(name) or kind not in _KINDS:
            raise ParameterError(
                f"item {name[:40]!r} is of kind {str(kind)[:40]!r}; expected {tuple(_KINDS)}"
            )

        def entry(one: Mapping[str, Any]) -> dict[str, Any]:
            return {
                "revision": int(one["revision"]),
                "time": _text(one["time"], "time", 40),
                "value": _KINDS[kind](one["value"]),
            }

        return {"kind": kind, **entry(item), "earlier": [entry(one) for one in item.get("earlier", [])]}

    def change(self, changes: list[Any]) -> dict[str, Any]:
        """Change items, all or none of them, and write the file whole.

        Parameters
        ----------
        changes : list of mapping
            ``id``, ``kind``, ``base`` (the revision that was seen; 0: none) and ``value`` (None: remove).

        Returns
        -------
        dict
            The document, with what others have changed meanwhile.

        Raises
        ------
        ParameterError
            If a change is not understood.
        ViewerError
            If the file cannot be read or written.
        """
        try:
            with self._lock, locked(self.path.parent):
                document = self.document()
                for one in changes:
                    self._apply(document, one)
                data = (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()
                if len(data) > MAX_BYTES:
                    raise ViewerError(
                        f"{self.path} would have {len(data)} bytes; expected {MAX_BYTES} at most"
                    )
                write_whole(self.path, data)
                return document
        except OSError as error:
            raise ViewerError(f"cannot write {self.path}: {error.strerror}") from error

    @staticmethod
    def _apply(document: dict[str, Any], change: Any) -> None:
        if not isinstance(change, dict):
            raise ParameterError("a change is not an object; expected id, kind, base and value")
        name, kind, base, value = (change.get(key) for key in ("id", "kind", "base", "value"))
        if not isinstance(name, str) or not _ID.fullmatch(name):
            raise ParameterError(f"id is {str(name)[:40]!r}; expected small letters, digits, - and _")
        if not isinstance(kind, str) or kind not in _KINDS:
            raise ParameterError(f"kind is {str(kind)[:40]!r}; expected one of {tuple(_KINDS)}")
        if isinstance(base, bool) or not isinstance(base, int) or base < 0:
            raise ParameterError(f"base is {str(base)[:40]!r}; expected the revision that was seen")
        items = document["items"]
        there = items.get(name)
        if there is not None and there["kind"] != kind:
            raise ParameterError(f"{name} is a {there['kind']}; expected that kind, not {kind}")
        seen = there is None or there["revision"] == base
        if value is None:
            if there is not None and seen:
                del items[name]
                document["revision"] += 1
            return
        if not isinstance(value, dict):
            raise ParameterError("value is not an object; expected one, or null")
        made = _KINDS[kind](value)
        if there is not None and there["value"] == made:
            return
        earlier = [] if there is None else there["earlier"]
        if there is not None and not seen:
            earlier = [*earlier, {key: there[key] for key in ("revision", "time", "value")}]
        document["revision"] += 1
        items[name] = {
            "kind": kind,
            "revision": document["revision"],
            "time": _now(),
            "value": made,
            "earlier": earlier,
        }


__all__ = ["FILE", "FORMAT", "VERDICTS", "Desk"]
