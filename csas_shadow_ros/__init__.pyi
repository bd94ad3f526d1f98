from .bags import Run, check_bag, read_run, write_run
from .core.errors import CsasError, InputTypeError, MissingExtraError, ParameterError
from .core.geometry import Acoustics, CoherentImage, Datum, GroundGrid, Track, View
from .core.imaging.subaperture import SubApertures
from .core.parameters import PipelineParameters
from .core.shape.mesh import Dimensions
from .core.shape.result import Quality, Result
from .core.shape.volume import VoxelGrid
from .public import parameters, reconstruct
from .run_bag import process_bag
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
