"""Entry point of ``csas-shadow``, which can be interrupted from its first moment on.

The command line imports libraries first: a Ctrl-C meanwhile would end in the middle of one, as a traceback.
"""

from __future__ import annotations

import os
import signal
from typing import NoReturn


def _interrupted(*_: object) -> NoReturn:
    os.write(2, b"csas-shadow: error: interrupted\n")
    os._exit(1)


def main() -> NoReturn:
    """Run the command line."""
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if usual:
        signal.signal(signal.SIGINT, _interrupted)
    from .cli import run_and_exit

    if usual:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run_and_exit()


if __name__ == "__main__":
    main()
