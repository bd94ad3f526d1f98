"""Results folders: grid, meshes, report, bag and figures of a run, and its score against a truth."""

from .check import ResultsCheck, check_results, looks_like_results
from .folder import ResultsError, ResultsWriter, is_results_folder, read_report
from .report import Context, build_report, summary
from .truth import KnownTruth, TruthError, read_truth, score

__all__ = [
    "Context",
    "KnownTruth",
    "ResultsCheck",
    "ResultsError",
    "ResultsWriter",
    "TruthError",
    "build_report",
    "check_results",
    "is_results_folder",
    "looks_like_results",
    "read_report",
    "read_truth",
    "score",
    "summary",
]
