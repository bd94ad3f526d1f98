from .check import ResultsCheck, check_results
from .folder import ResultsWriter
from .layout import ResultsError, is_results_folder, looks_like_results, read_report
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
