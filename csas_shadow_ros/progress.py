"""A progress bar where somebody looks: in a terminal or a notebook, silent elsewhere."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator

#: A function of (done, in all); True: a bar; False: none; None: a bar in a terminal or a notebook.
ProgressOption = Callable[[int, int], None] | bool | None


def in_notebook() -> bool:
    """Say whether a Jupyter kernel runs this program."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


@contextlib.contextmanager
def progress_bar(option: ProgressOption, what: str) -> Iterator[Callable[[int, int], None]]:
    """Give a function of (done, in all) that shows how far something is.

    Parameters
    ----------
    option : callable, bool or None
        See `ProgressOption`.
    what : str
        What is counted.
    """
    if callable(option):
        yield option
        return
    notebook = in_notebook()
    wanted = option if option is not None else notebook or sys.stderr.isatty()
    if not wanted:
        yield lambda *_: None
        return
    widgets = notebook and importlib.util.find_spec("ipywidgets") is not None
    library = importlib.import_module("tqdm.notebook" if widgets else "tqdm")
    with library.tqdm(desc=what, unit="", file=sys.stderr, leave=False) as shown:

        def move(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield move
