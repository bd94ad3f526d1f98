"""Recover shadows and 3-D shape from circular synthetic aperture sonar imagery.

What a program needs is here by name; `docs/python.md` shows it. A name is loaded when it is first used.

That is lazy_loader's work, here and in `results`. Inside the package, what is slow to import and seldom used
(scipy.signal: 1.9 s on two busy cores, ``python -c "import scipy.signal"``) is imported in the function
that uses it, with a comment ("Late: …"). ``lazy_loader.load`` gives whole modules, untyped, so that mypy
would check nothing of them, and loads the parent of a submodule at once; most late imports are of single
names of our own.
"""

import lazy_loader

__version__ = "0.1.0"

# The names, and where each is, stand in __init__.pyi: type checkers and editors read the same list.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
