from .bags import Run, check_bag, read_run, write_run
from .core.errors import CsasError, InputTypeError, MissingExtraError, ParameterError
from .core.geometry import Acoustics, CoherentImage, Datum, GroundGrid, Track, View
from .core.mesh import Dimensions
from .core.parameters import PipelineParameters
from .core.shape.result import Quality, Result
from .core.subaperture import SubApertures
from .core.volume import VoxelGrid
from .process import process_bag
from .public import parameters, reconstruct
from .simulation import Faults, SimulatedRun, simulate, simulate_bag

__all__ = [
    "Acoustics",
    "CoherentImage",
    "CsasError",
    "Datum",
    "Dimensions",
    "Faults",
    "GroundGrid",
    "InputTypeError",
    "MissingExtraError",
    "ParameterError",
    "PipelineParameters",
    "Quality",
    "Result",
    "Run",
    "SimulatedRun",
    "SubApertures",
    "Track",
    "View",
    "VoxelGrid",
    "check_bag",
    "parameters",
    "process_bag",
    "read_run",
    "reconstruct",
    "simulate",
    "simulate_bag",
    "write_run",
]

__version__: str
