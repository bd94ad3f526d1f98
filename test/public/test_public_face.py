"""What a program sees: names by need, short texts, pictures, one line from a bag to a shape."""

from __future__ import annotations

import ast
import base64
import doctest
import io
import math
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.image import imread

import csas_shadow_ros as csas
from csas_shadow_ros.core.later_stages import STAGES
from csas_shadow_ros.core.pipeline import run as run_pipeline
from csas_shadow_ros.progress import progress_bar

ROOT = Path(__file__).resolve().parents[2]
COARSE = {"step_deg": 15.0, "voxel_size_m": 0.04}


@pytest.fixture(scope="module")
def box_result(tiny_box_bag):
    return csas.reconstruct(csas.read_run(tiny_box_bag.path), csas.parameters(**COARSE))


@pytest.fixture(scope="module")
def empty_result(tiny_empty_bag):
    return csas.reconstruct(csas.read_run(tiny_empty_bag.path), csas.parameters(**COARSE))


@pytest.fixture(scope="module")
def bag_of_every_stage(tiny_box_bag, tmp_path_factory):
    out = tmp_path_factory.mktemp("stages") / "out"
    csas.process_bag(tiny_box_bag.path, out, csas.parameters(**COARSE), figures=False, durable=False)
    return out / "result.mcap"


# -- names ------------------------------------------------------------------------------------------


def test_importing_the_package_loads_no_library():
    script = "import sys, csas_shadow_ros; print(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, timeout=60, check=True
    )
    assert not {"numpy", "scipy", "matplotlib", "tqdm", "rosbags", "numba"} & set(done.stdout.split())


def test_every_name_of_the_stub_is_there_and_listed():
    stub = ast.parse((ROOT / "csas_shadow_ros" / "__init__.pyi").read_text(encoding="utf-8"))
    imported = {a.name for node in stub.body if isinstance(node, ast.ImportFrom) for a in node.names}
    (listed,) = (ast.literal_eval(node.value) for node in stub.body if isinstance(node, ast.Assign))
    assert set(listed) == imported == set(csas.__all__)
    for name in listed:
        assert getattr(csas, name).__name__ == name
        assert name in dir(csas)


def public_functions():
    yield from (getattr(csas, name) for name in csas.__all__)
    yield from (csas.Result.plot, csas.Result.to_xarray, csas.Run.of)


def examples():
    finder = doctest.DocTestFinder(recurse=False)
    for thing in public_functions():
        # An example that a class inherits, or that a module tells of, is run where it stands.
        for found in finder.find(thing, thing.__qualname__):
            if found.examples:
                yield found


@pytest.mark.parametrize("example", list(examples()), ids=lambda found: found.name)
def test_the_example_of_each_public_function_runs(example, tiny_box_bag, tmp_path, monkeypatch):
    if "to_xarray" in example.name:
        pytest.importorskip("xarray")
    shutil.copytree(tiny_box_bag.path, tmp_path / "box_run")
    monkeypatch.chdir(tmp_path)
    told = io.StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
    failed = runner.run(example, out=told.write).failed
    assert not failed, told.getvalue()


def test_every_public_function_has_an_example():
    shown = {found.name for found in examples()}
    functions = {thing.__qualname__ for thing in public_functions() if not isinstance(thing, type)}
    assert functions <= shown


def python_blocks(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def test_the_readme_shows_what_the_page_on_python_begins_with():
    assert python_blocks("README.md") == python_blocks("docs/python.md")[:1]


# -- from what a bag holds to a result --------------------------------------------------------------


def test_a_bag_with_an_image_is_reconstructed_as_the_pipeline_does(tiny_box_bag, box_result):
    run = tiny_box_bag.run
    expected = run_pipeline(run.image, run.track, csas.parameters(**COARSE))
    assert np.array_equal(box_result.grid.likelihood, expected.grid.likelihood, equal_nan=True)
    assert box_result.dimensions == expected.dimensions


def test_a_simulated_run_needs_no_bag(tiny_box_bag, box_result):
    made = csas.reconstruct(tiny_box_bag.run, csas.parameters(**COARSE))
    assert np.array_equal(made.grid.occupied, box_result.grid.occupied)
    assert made.run_ns == box_result.run_ns


def test_sectors_are_reconstructed_as_their_sum(tmp_path, box_result):
    csas.simulate_bag(tmp_path / "run", "tiny", "box", seed=5, heading_deg=20.0, sectors_deg=30.0)
    run = csas.read_run(tmp_path / "run")
    assert run.image is None
    assert csas.reconstruct(run, csas.parameters(**COARSE)).dimensions == box_result.dimensions


@pytest.mark.parametrize("stage", STAGES)
def test_views_of_any_stage_are_taken_on_from_there(bag_of_every_stage, box_result, stage):
    soft = {"method": "soft"} if stage == "likelihood" else {}
    run = csas.read_run(bag_of_every_stage)
    result = csas.reconstruct(run, csas.parameters(**COARSE, **soft), start_from=stage)
    expected = box_result.other_grid if soft else box_result.grid
    assert result.grid.method == expected.method
    assert np.array_equal(result.grid.likelihood, expected.likelihood, equal_nan=True)
    assert result.best_shadow is not None


def test_process_bag_leaves_the_grid_that_reconstruct_returns(bag_of_every_stage, box_result):
    with np.load(bag_of_every_stage.parent / "grid.npz") as grid:
        assert np.array_equal(grid["occupied"], box_result.grid.occupied)


# -- wrong input ------------------------------------------------------------------------------------

WRONG = {
    "path": (TypeError, lambda run: csas.read_run(7)),
    "run number": (TypeError, lambda run: csas.read_run("box_run", run="first")),
    "no such bag": (ValueError, lambda run: csas.read_run("no_such_bag")),
    "run": (TypeError, lambda run: csas.reconstruct("box_run")),
    "parameters": (TypeError, lambda run: csas.reconstruct(run, {"step_deg": 5})),
    "start_from": (ValueError, lambda run: csas.reconstruct(run, start_from="mesh")),
    "stage not held": (ValueError, lambda run: csas.reconstruct(run, start_from="shadow")),
    "spectrum_sign": (ValueError, lambda run: csas.reconstruct(run, spectrum_sign=2)),
    "workers": (ValueError, lambda run: csas.reconstruct(run, workers=0)),
    "workers kind": (TypeError, lambda run: csas.reconstruct(run, workers="two")),
    "max_objects": (ValueError, lambda run: csas.reconstruct(run, max_objects=65)),
    "value": (ValueError, lambda run: csas.parameters(step_deg=-1)),
    "name": (ValueError, lambda run: csas.parameters(stepdeg=1)),
    "choice": (ValueError, lambda run: csas.parameters(method="best")),
    "file": (TypeError, lambda run: csas.parameters({"step_deg": 5})),
    "profile": (ValueError, lambda run: csas.simulate("huge")),
    "profile kind": (TypeError, lambda run: csas.simulate(3)),
    "target": (ValueError, lambda run: csas.simulate("tiny", "boat")),
    "target kind": (TypeError, lambda run: csas.simulate("tiny", 3.0)),
    "bag kind": (TypeError, lambda run: csas.simulate_bag(None, "tiny")),
    "check": (TypeError, lambda run: csas.check_bag(None)),
    "process": (TypeError, lambda run: csas.process_bag(None, "out")),
    "process out": (TypeError, lambda run: csas.process_bag("box_run", None)),
    "write path": (TypeError, lambda run: csas.write_run(None, run.image, run.track)),
    "write image": (TypeError, lambda run: csas.write_run("new", np.zeros((4, 4)), run.track)),
    "write track": (TypeError, lambda run: csas.write_run("new", run.image, [1, 2, 3])),
    "image": (TypeError, lambda run: csas.Run.of(np.zeros((4, 4)), run.track)),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_our_error_and_pythons(case, tiny_box_bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kind, call = WRONG[case]
    with pytest.raises(csas.CsasError) as caught:
        call(csas.Run.of(tiny_box_bag.run.image, tiny_box_bag.run.track))
    assert isinstance(caught.value, kind)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


# -- progress ---------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "option", "shown"),
    [
        (Terminal, None, True),
        (Terminal, False, False),
        (io.StringIO, None, False),
        (io.StringIO, True, True),
    ],
)
def test_there_is_a_bar_in_a_terminal_and_where_it_is_asked_for(monkeypatch, stream, option, shown):
    told = stream()
    monkeypatch.setattr(sys, "stderr", told)
    with progress_bar(option, "views") as bar:
        bar(1, 4)
    assert ("views" in told.getvalue()) == shown


def test_a_callable_takes_every_view(tiny_box_bag):
    seen = []
    csas.reconstruct(
        tiny_box_bag.run, csas.parameters(**COARSE), progress=lambda done, total: seen.append((done, total))
    )
    assert seen == [(n, 24) for n in range(1, 25)]


# -- what results look like -------------------------------------------------------------------------


def test_everything_prints_in_a_few_lines(tiny_box_bag, bag_of_every_stage, box_result, empty_result):
    run = csas.read_run(bag_of_every_stage)
    views = csas.SubApertures(tiny_box_bag.run.image, tiny_box_bag.run.track)
    things = [
        tiny_box_bag.run, run, run.image, run.track, next(run.views("shadow")), views,
        box_result, box_result.dimensions, box_result.grid, box_result.objects, empty_result,
    ]  # fmt: skip
    for thing in things:
        text = repr(thing)
        assert 20 < len(text) < 600, (type(thing), len(text))
        assert text.count("\n") < 8


def test_a_result_prints_its_verdict_and_measures(box_result, empty_result):
    d = box_result.dimensions
    assert repr(box_result).startswith("Result: object, quality ")
    assert f"{d.length_m:.3f} × {d.width_m:.3f} × {d.height_m:.3f} m" in repr(box_result)
    assert f"{box_result.views_used} views used" in repr(box_result)
    assert repr(empty_result).startswith("Result: no object")


class Table(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.cells, self.pictures, self._open = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._open = tag in ("td", "th")
        if tag == "img":
            self.pictures.append(dict(attrs)["src"])

    def handle_data(self, data):
        if self._open:
            self.cells.append(data)


@pytest.mark.parametrize("which", ["box_result", "empty_result"])
def test_a_notebook_shows_a_table_and_a_small_picture(which, request):
    result = request.getfixturevalue(which)
    text = result._repr_html_()
    assert len(text) < 200_000
    shown = Table(text)
    values = dict(zip(shown.cells[::2], shown.cells[1::2], strict=True))
    assert values["verdict"] == result.verdict
    assert ("length" in values) == (result.dimensions is not None)
    (source,) = shown.pictures
    picture = imread(io.BytesIO(base64.b64decode(source.partition("base64,")[2])))
    assert picture.std() > 0.01


def test_a_reason_is_no_markup(box_result):
    import copy

    odd = copy.copy(box_result)
    odd.quality = csas.Quality("limited", ("a < b <script>",))
    assert "<script>" not in odd._repr_html_()


@pytest.mark.parametrize("which", ["box_result", "empty_result"])
def test_a_plot_shows_plan_side_and_shadow_and_leaves_pyplot_alone(which, request, tmp_path):
    result = request.getfixturevalue(which)
    figure = result.plot()
    assert plt.get_fignums() == []
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert [title.split(",")[0] for title in titles] == ["plan", "side", "best shadow"]
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert any(axes.images for axes in figure.axes)


def test_the_best_shadow_is_drawn_sonar_up_with_its_shadow_below_the_target(box_result):
    shadow = next(axes for axes in box_result.plot().axes if axes.get_title().startswith("best"))
    (image,) = shadow.images
    near, far = sorted(shadow.get_ylim())
    assert shadow.get_ylim() == (far, near)  # down-range grows downwards
    pixels, (left, right, bottom, top) = image.get_array(), image.get_extent()
    down = top + (np.arange(pixels.shape[0]) + 0.5) * (bottom - top) / pixels.shape[0]
    across = left + (np.arange(pixels.shape[1]) + 0.5) * (right - left) / pixels.shape[1]
    middle = np.abs(across) < 0.15
    height, grazing = box_result.dimensions.height_m, box_result.best_shadow.info.camera.grazing_rad
    behind = (down > 0.3) & (down < 0.8 * height / math.tan(grazing))
    before = (down < -0.6) & (down > -1.0)
    assert pixels[np.ix_(behind, middle)].mean() < 0.8 * pixels[np.ix_(before, middle)].mean()


def test_without_xarray_the_error_names_the_extra(box_result, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(csas.MissingExtraError, match=re.escape("pip install 'csas_shadow_ros[xarray]'")):
        box_result.to_xarray()


def test_xarray_has_the_grid_on_its_coordinates(box_result, empty_result):
    pytest.importorskip("xarray")
    data, grid = box_result.to_xarray(), box_result.grid
    assert dict(data.sizes) == dict(zip("zyx", grid.volume.shape, strict=True))
    z, y, x = (int(i) for i in np.argwhere(grid.occupied)[0])
    at = data.sel(z=grid.volume.z_m[z], y=grid.volume.y_m[y], x=grid.volume.x_m[x])
    assert bool(at.occupied)
    assert float(at.likelihood) == float(grid.likelihood[z, y, x])
    assert data.attrs["length_m"] == box_result.dimensions.length_m
    assert empty_result.to_xarray().attrs["verdict"] == "no object"
