"""Results folders: grid, meshes, report, bag and figures of a run, and its score against a truth.

A name is loaded when it is first used, as in the package: who reads a report needs no chain.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
