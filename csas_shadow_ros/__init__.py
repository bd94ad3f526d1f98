"""Recover shadows and 3-D shape from circular synthetic aperture sonar imagery.

What a program needs is here by name; `docs/python.md` shows it. A name is loaded when it is first used.
"""

import lazy_loader

__version__ = "0.1.0"

# The names, and where each is, stand in __init__.pyi: type checkers and editors read the same list.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
