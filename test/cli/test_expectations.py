"""Runs that are held against what is expected of them, as continuous integration does."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from csas_shadow_ros.cli import build_parser, main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.expectations import (
    OF_OBJECT,
    OF_RUN,
    Checked,
    check_report,
    read_expectations,
    write_junit,
)

ROOT = Path(__file__).resolve().parents[2]
CI = ROOT / "examples" / "ci"
QUICK = ["--step-deg", "20", "--voxel-size-m", "0.08", "--no-bag", "--no-figures", "--quiet"]


@pytest.fixture(scope="session")
def report(tiny_box_bag: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("expected") / "out"
    assert main(["run", str(tiny_box_bag.path), "--out", str(out), *QUICK]) == 0
    return dict(json.loads((out / "report.json").read_text()))


def expectations(tmp_path: Path, text: str) -> Any:
    file = tmp_path / "expect.yaml"
    file.write_text(text)
    return read_expectations(file)


def test_every_value_that_can_be_expected_is_in_a_report(report: dict[str, Any]) -> None:
    assert None not in {get(report) for get in OF_RUN.values()}
    (entry,) = report["objects"]
    missing = {name for name, get in OF_OBJECT.items() if get(entry) is None}
    assert missing == {"latitude_deg", "longitude_deg", "bearing_deg"}  # nobody says where on earth it is


@pytest.mark.parametrize(
    "text",
    [
        "verdict: object",
        "quality: [good, limited, not trustworthy]",
        "length_m: {is: 0.8, within: 0.2}",
        "height_m: {min: 0.2}",
        "views_lost: {max: 0}",
        "views_lost: 0",
        "object_1: {width_m: {min: 0.2, max: 0.8}}",
        "heading_deg: {is: 20, within: 15}",
        "heading_deg: {is: -160, within: 15}",
        "heading_deg: {min: 185, max: 215}",
    ],
)
def test_what_is_as_expected_has_no_fault(tmp_path: Path, report: dict[str, Any], text: str) -> None:
    assert check_report("a", report, expectations(tmp_path, text)).unmet == []


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("verdict: no object", "^verdict is object; expected 'no object'$"),
        ("verdict: [undecided, no object]", "^verdict is object; expected 'undecided' or 'no object'$"),
        ("length_m: {is: 3, within: 0.2}", r"^length_m is 0\.\d+; expected 2.8 to 3.2$"),
        ("views_used: {min: 1000}", r"^views_used is \d+; expected at least 1000$"),
        ("seconds: {max: 0}", "^seconds is .*; expected at most 0$"),
        ("object_2: {length_m: {min: 0}}", r"^object_2\.length_m is not known; expected at least 0$"),
        ("latitude_deg: {min: 0}", "^latitude_deg is not known"),
        ("heading_deg: {is: 110, within: 15}", "^heading_deg is .*; expected 95 to 125$"),
    ],
)
def test_what_is_not_as_expected_is_named_with_both_values(
    tmp_path: Path, report: dict[str, Any], text: str, match: str
) -> None:
    (fault,) = check_report("a", report, expectations(tmp_path, text)).unmet
    assert re.search(match, fault), fault


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("lenght_m: 1", "there is no value 'lenght_m'; expected one of: verdict, quality"),
        ("object_2: 5", "object_2 is 5; expected names and values of that object"),
        ("object_2: {verdict: object}", "there is no value 'verdict'; expected one of: length_m"),
        (
            "length_m: {is: 1}",
            r"length_m is \{'is': 1\}; expected numbers named is and within, or min and max",
        ),
        ("length_m: {min: a}", "expected numbers named"),
        ("length_m: {min: 2, max: 1}", "which no value can be"),
        ("verdict: objekt", "verdict is 'objekt'; expected one of: object, no object, undecided"),
        ("quality: [good, okay]", "quality is 'okay'; expected one of: good, limited, not trustworthy"),
        ("length_m: long", "length_m is 'long'; expected a number"),
        ("length_m: []", "expected a value, a list of them, or bounds"),
        ("- a", "is not a mapping"),
        ("a: {", "cannot be read"),
    ],
)
def test_a_slip_in_the_file_is_refused_by_name(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(ParameterError, match=match):
        expectations(tmp_path, text)


def test_a_run_that_is_not_as_expected_ends_with_4_and_keeps_its_results(
    tmp_path: Path, tiny_box_bag: Any, capsys: Any
) -> None:
    expect, junit, out = tmp_path / "expect.yaml", tmp_path / "reports" / "junit.xml", tmp_path / "out"
    expect.write_text("verdict: object\nlength_m: {is: 5, within: 0.1}\n")
    common = ["run", str(tiny_box_bag.path), "--out", str(out), *QUICK, "--junit", str(junit)]
    assert main([*common, "--expect", str(expect)]) == 4
    assert (out / "grid.npz").exists()
    assert "error: out: length_m is 0." in capsys.readouterr().err
    (suite,) = ElementTree.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("3", "1", "0")
    assert float(suite.get("time") or 0) > 0
    failed = {case.get("name") for case in suite if case.find("failure") is not None}
    assert failed == {"length_m"}
    assert {case.get("name") for case in suite} == {"run", "verdict", "length_m"}
    expect.write_text("verdict: object\nlength_m: {min: 0.1}\n")
    loud = [one for one in common if one not in ("-q", "--quiet")]
    assert main([*loud, "--overwrite", "--expect", str(expect)]) == 0
    assert f"out: as {expect} expects (2 values)" in capsys.readouterr().err


def test_a_run_that_fails_is_an_error_in_the_junit_file_and_a_slip_costs_no_run(
    tmp_path: Path, capsys: Any
) -> None:
    expect, junit = tmp_path / "expect.yaml", tmp_path / "junit.xml"
    expect.write_text("verdict: object\n")
    command = ["run", str(tmp_path / "nothing"), "--out", str(tmp_path / "out"), "--quiet"]
    assert main([*command, "--expect", str(expect), "--junit", str(junit)]) == 1
    (suite,) = ElementTree.parse(junit).getroot()
    assert suite.get("errors") == "1"
    assert "BagError" in (suite.find("testcase/error").get("message") or "")  # type: ignore[union-attr]
    expect.write_text("verdit: object\n")
    assert main([*command, "--expect", str(expect)]) == 1
    assert "there is no value 'verdit'" in capsys.readouterr().err


def test_the_junit_file_is_xml_whatever_the_text(tmp_path: Path) -> None:
    write_junit(tmp_path / "j.xml", [Checked("<a&b>", {"x": 'a \x1b[31m <fault> & "more"'}, 1.5, "bad \0")])
    (suite,) = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert suite.get("name") == "<a&b>"


# The examples


def test_the_examples_commands_and_files_are_understood() -> None:
    workflow = yaml.safe_load((CI / "replay.yml").read_text())
    (job,) = workflow["jobs"].values()
    lines = "\n".join(step.get("run", "") for step in job["steps"]).replace("\\\n", " ").splitlines()
    commands = [line.split()[1:] for line in lines if line.strip().startswith("csas-shadow ")]
    assert [command[0] for command in commands] == ["warm", "check", "replay"]
    for command in commands:
        parsed = build_parser().parse_args(command)
    assert read_expectations(ROOT / parsed.expect)
    page = (ROOT / "docs" / "replay_in_ci.md").read_text()
    for name in (*OF_RUN, *OF_OBJECT):
        assert f"`{name}`" in page
    for block in re.findall(r"```yaml\n(.*?)```", page, re.S):
        assert yaml.safe_load(block)
