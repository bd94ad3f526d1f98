"""Read metadata.yaml of a rosbag2 directory within bounds; the files themselves count."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from yaml.composer import Composer, ComposerError
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

from csas_shadow_ros.core.errors import BagError

from .storage import open_regular

METADATA = "metadata.yaml"
#: Characters, also with all aliases written out. A topic takes 900, a file 200: room for 5000 files of a day.
_MOST_CHARACTERS = 1 << 21
#: rosbag2 nests seven deep.
_MOST_DEPTH = 32

# libyaml parses ten times as fast; where PyYAML was built without it the Python parser does.
_Parser: Any = yaml.cyaml.CParser if yaml.__with_libyaml__ else yaml.SafeLoader


class _Loader(Composer, _Parser, SafeConstructor, Resolver):  # type: ignore[misc]  # PyYAML has no types
    """Loads plain YAML whose depth, and whose size with all aliases written out, are bounded."""

    def __init__(self, text: str) -> None:
        if yaml.__with_libyaml__:
            yaml.cyaml.CParser.__init__(self, text)
            Composer.__init__(self)
            SafeConstructor.__init__(self)
            Resolver.__init__(self)
        else:
            yaml.SafeLoader.__init__(self, text)
        self._depth = 0
        #: Characters of the nodes that are being composed, innermost last, and of those that are done.
        self._open = [0]
        self._size: dict[int, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        mark = self.peek_event().start_mark
        if self.check_event(yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._size:
                raise ComposerError(None, None, "an alias contains itself", mark)
            size = self._size[id(node)]
        else:
            self._depth += 1
            if self._depth > _MOST_DEPTH:
                raise ComposerError(None, None, f"it nests deeper than {_MOST_DEPTH}", mark)
            self._open.append(1)
            node = super().compose_node(parent, index)
            size = self._open.pop() + (len(node.value) if isinstance(node, yaml.ScalarNode) else 0)
            self._size[id(node)] = size
            self._depth -= 1
        self._open[-1] += size
        if self._open[-1] > _MOST_CHARACTERS:
            raise ComposerError(None, None, "its aliases unfold without bounds", mark)
        return node


class Metadata(NamedTuple):
    """What a reader needs of metadata.yaml.

    Parameters
    ----------
    files : list of str
        Names of the storage files, without folders.
    message_count : int
        Messages that the recorder counted; 0 if it does not say.
    information : dict
        All of it, ready for JSON.
    """

    files: list[str]
    message_count: int
    information: dict[str, Any]


def read_metadata(folder: Path) -> Metadata:
    """Read a bag's metadata.yaml.

    Raises
    ------
    BagError
        If it cannot be read, is none, or is larger than any recorder writes.
    """
    path = folder / METADATA
    try:
        with open_regular(path) as file:
            data = file.read(_MOST_CHARACTERS + 1)
        if len(data) > _MOST_CHARACTERS:
            raise BagError(f"{path} cannot be read (it is larger than {_MOST_CHARACTERS} bytes)")
        information = _plain(yaml.load(data.decode(), Loader=_Loader)["rosbag2_bagfile_information"])
        files = [Path(name).name for name in information["relative_file_paths"]]
        count = information.get("message_count", 0)
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{path} cannot be read ({error.strerror})") from error
    except KeyError as error:
        raise BagError(f"{path} cannot be read ({error} is missing)") from error
    except (yaml.YAMLError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise BagError(f"{path} cannot be read ({_short(error)})") from error
    return Metadata(files, count if isinstance(count, int) else 0, information)


def _plain(value: Any) -> Any:
    """Return what JSON knows: YAML has dates, sets, bytes, NaN and integers of any size besides."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(v) for v in value]
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return value if abs(value) < 1 << 64 else hex(value)
    return value if isinstance(value, float) and math.isfinite(value) else str(value)


def _short(error: Exception) -> str:
    """Return the first line of what is wrong, and where."""
    mark = getattr(error, "problem_mark", None)
    text = (getattr(error, "problem", None) or str(error)).splitlines()
    place = f", line {mark.line + 1}" if mark is not None else ""
    return f"{text[0][:120] if text else type(error).__name__}{place}"
