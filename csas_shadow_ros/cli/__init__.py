"""``csas-shadow``: one file a command, over `options`, `console` and `main`."""

from .main import build_parser, main, run_and_exit

__all__ = ["build_parser", "main", "run_and_exit"]
