"""Results folders: grid, meshes, report, bag and figures of a run, and its score against a truth."""

from .folder import ResultsError, ResultsWriter, is_results_folder, read_report
from .report import Context, build_report, summary
from .truth import KnownTruth, TruthError, read_truth, score

__all__ = [
    "Context",
    "KnownTruth",
    "ResultsError",
    "ResultsWriter",
    "TruthError",
    "build_report",
    "is_results_folder",
    "read_report",
    "read_truth",
    "score",
    "summary",
]
