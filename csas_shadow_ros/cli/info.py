"""``csas-shadow info``: what a bag or a results folder holds."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from .console import OK, Console
from .options import output_options


def add_info(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``info``."""
    info = add(
        "info",
        "list the contents of a bag or a results folder",
        "  csas-shadow info box_run\n  csas-shadow info box_results",
        _info,
    )
    info.add_argument("path", metavar="BAG|DIR", help="a bag, or a results folder")
    info.add_argument("--namespace", help="namespace of the bag's topics (default: detect it)")
    output_options(info)


def _info(arguments: argparse.Namespace, console: Console) -> int:
    from ..results import is_results_folder, read_report, summary

    if is_results_folder(arguments.path):
        report = read_report(arguments.path)
        text = summary(report) + f"from {report['input'].get('path', '?')}, started from {report['stage']}\n"
        text += "files: " + ", ".join(f for f in report["files"] if "/" not in f)
        drawn = [f for f in report["files"] if f.startswith("figures/")]
        console.result(text + f", {len(drawn)} figures", report)
        return OK
    from ..bags import read_run
    from ..results import read_truth
    from ..results.layout import json_ready
    from ..run_bag import describe_run, stages_of, topic_sizes

    run = read_run(arguments.path, arguments.namespace)
    about = describe_run(run)
    for topic, size in topic_sizes(run).items():
        about["topics"][topic]["bytes"] = size
    truth = read_truth(arguments.path)
    about["truth"] = None
    if truth is not None:
        about["truth"] = {"mesh": str(truth.path), "dimensions": truth.dimensions, "record": truth.record}
    about["start_from"] = stages_of(run)
    about["problems"] = [str(problem) for problem in run.problems]
    about = json_ready(about)
    console.result(_bag_text(about), about)
    return OK


def size_text(count: float) -> str:
    """Return a number of bytes as text."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def _bag_text(about: dict[str, Any]) -> str:
    lines = [f"{about['path']}: {about['messages']} messages, {size_text(about['bytes'])}", ""]
    width = max((len(name) for name in about["topics"]), default=0)
    for name, topic in about["topics"].items():
        size = size_text(topic.get("bytes", 0))
        lines.append(f"  {name:<{width}}  {topic['messages']:>6}  {size:>9}  {topic['type']}")
    lines.append("")
    sectors = about["sectors"]
    if sectors:
        lines.append(f"sectors {sectors['count']} that cover {sectors['covered_deg']:.1f} of 360°")
        if sectors["missing"]:
            lines.append(f"        missing: {', '.join(sectors['missing'][:8])}")
    if image := about["image"] or (sectors and sectors["image"]):
        e = image["extent_m"]
        lines.append(
            f"image   {image['rows']} x {image['cols']} pixels of {image['spacing_m'] * 1e3:g} mm:"
            f" x {e['left']:.2f} to {e['right']:.2f} m, y {e['bottom']:.2f} to {e['top']:.2f} m"
        )
        lines.append(
            f"band    {image['centre_frequency_hz'] / 1e3:g} kHz ± {image['bandwidth_hz'] / 2e3:g} kHz,"
            f" sound speed {image['sound_speed_mps']:g} m/s, spectrum sign {image['spectrum_sign']:+d}"
        )
    if track := about["track"]:
        lines.append(
            f"track   {track['poses']} poses over {track['coverage_deg']:.1f}° {track['direction']}, radius"
            f" {track['radius_m']:.2f} m, height {track['height_m']:.2f} m,"
            f" grazing {track['grazing_deg']:.1f}°"
        )
        if track["gaps"]:
            lines.append(f"        missing: {', '.join(track['gaps'][:8])}")
    if truth := about["truth"]:
        d = truth["dimensions"]
        what = truth["record"].get("name", "target")
        lines.append(
            f"truth   {what}"
            + (f" {d['length_m']:.3f} x {d['width_m']:.3f} x {d['height_m']:.3f} m" if d else ": no object")
            + f" ({truth['mesh']})"
        )
    names = [
        "image (summed from the sectors)" if name == "image" and about["image"] is None else name
        for name in about["start_from"]
    ]
    starts = ", ".join(names) or "nothing: see `csas-shadow check`"
    lines.append(f"a run can start from: {starts}")
    lines += [f"problem: {problem}" for problem in about["problems"]]
    return "\n".join(lines)
