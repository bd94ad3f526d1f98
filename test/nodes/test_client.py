"""Outside classifiers as real processes beside, and within, a graph of real processes: no view is lost."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

import graph_of_nodes  # noqa: F401  (this machine alone, before rclpy makes a context)
import rclpy
from graph_of_nodes import VOXEL_M
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from csas_shadow_ros import client, parameters
from csas_shadow_ros.client import ViewSubscriber
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.graph.processes import (
    DomainReservation,
    Graph,
    ReplayError,
    graph_environment,
    start_fork_server,
)
from csas_shadow_ros.graph.replay import replay
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.runtime import hearing
from csas_shadow_ros.nodes.runtime.shared_memory import owned_files
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from msg_adapters import Heartbeat, RclpyMessages, measurements_from_msg, progress_from_msg
from msg_adapters.topics import TOPICS

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "classifier.py"
VIEWS = 72
PATIENCE_S = 150.0


class Live:
    """A graph of processes that stays when the run is over, and what is heard of it."""

    def __init__(self, graph: Graph, domain: int, folder: Path) -> None:
        self.graph, self.folder = graph, folder
        self.environment = {
            k: v for k, v in graph_environment(domain, folder).items() if k != "CSAS_PARENT_PID"
        }
        self.environment["PYTHONUNBUFFERED"] = "1"
        self.beats: dict[tuple[str, str], Heartbeat] = {}
        #: (node, stream) -> stamp -> outcome, "rejected: why" where there is a reason.
        self.reports: dict[tuple[str, str], dict[int, str]] = {}
        self.measurements: Any = None
        self.children: list[subprocess.Popen[bytes]] = []
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("onlooker", context=self.context, namespace="csas")
        kind = RclpyMessages().cls(TOPICS["progress"].type_name)
        self.node.create_subscription(kind, "progress", self._hear, qos.REPORTS)
        self.node.create_subscription(kind, "measurements", self._measured, qos.LATCHED)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def _hear(self, msg: Any) -> None:
        item = progress_from_msg(msg)
        key = (item.node, item.values.get("stream", item.values.get("input", "")))
        if isinstance(item, Heartbeat):
            self.beats[key] = item
        else:
            told = f"{item.outcome}: {item.reason}" if item.reason else item.outcome
            self.reports.setdefault(key, {})[item.stamp_ns] = told

    def _measured(self, msg: Any) -> None:
        self.measurements = measurements_from_msg(msg)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            counts = {k: dict(b.counts) for k, b in self.beats.items()}
            assert time.monotonic() < end, f"not within {PATIENCE_S:g} s: {what}\n{counts}\n{self.logs()}"
            self.graph.watch()
            self.executor.spin_once(timeout_sec=0.05)

    def logs(self) -> str:
        return "\n".join(f"{p.name}: {p.read_text()[-600:]}" for p in self.folder.glob("*.log"))

    def carved(self) -> int:
        """Views in the grid, once the carver says that these are all."""
        beats = [b for (node, _), b in self.beats.items() if node == "voxel_carver" and b.counts["complete"]]
        return max((b.counts["views"] for b in beats), default=0)

    def told(self, node: str, stream: str = "shadow") -> dict[int, str]:
        return self.reports.get((node, stream), {})

    def start(self, *command: object) -> Outside:
        made = Outside(self, [str(c) for c in command], self.folder / f"outside_{len(self.children)}.log")
        self.children.append(made.process)
        return made

    def close(self) -> None:
        for process in self.children:
            if process.poll() is None:
                process.kill()
            process.wait()
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Outside:
    """A process of somebody else's; what it prints begins with the stamp of a view."""

    def __init__(self, live: Live, command: Sequence[str], log: Path) -> None:
        self.log = log
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, *command], env=live.environment, stdout=output, stderr=subprocess.STDOUT
            )

    def stamps(self) -> list[str]:
        return [s for s in re.findall(r"^([\d.]{10,}) ", self.log.read_text(), re.MULTILINE)]

    def over(self) -> list[str]:
        """Names of the runs that it says are over, each after the last view."""
        lines = self.log.read_text().splitlines()
        told = [n for n, line in enumerate(lines) if line.startswith("the run of ")]
        assert all(n >= VIEWS for n in told)
        return [lines[n].split()[3] for n in told]

    def got(self, views: int) -> Callable[[], bool]:
        return lambda: len(set(self.stamps())) >= views

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(20.0) == 0, self.log.read_text()


@pytest.fixture
def live(run_bag: Path, tmp_path: Path) -> Iterator[Callable[..., Live]]:
    with contextlib.ExitStack() as stack:

        def make(**changes: dict[str, Any] | None) -> Live:
            plan: dict[str, Any] = {
                "bag_player": {"bag": str(run_bag)},
                "sub_aperture": {"step_deg": 360.0 / VIEWS},
                "shadow_enhancement": {},
                "shadow_likelihood": {},
                "voxel_carver": {"voxel_size_m": VOXEL_M},
            }
            for node, own in changes.items():
                plan.pop(node) if own is None else plan[node].update(own)
            domain = stack.enter_context(DomainReservation())
            server = stack.enter_context(start_fork_server(domain, tmp_path))
            graph = stack.enter_context(Graph(plan, domain, tmp_path, server=server))
            made = Live(graph, domain, tmp_path)
            stack.callback(made.close)
            return made

        yield make


def program(tmp_path: Path, text: str) -> Path:
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "outside.py"
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


def page_program(tmp_path: Path) -> Path:
    """The page's own program, word for word."""
    page = (ROOT / "docs" / "flow_control.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert not re.search(r"import .*(csas|msg_adapters)|from (csas|msg_adapters)", code), (
        "it imports none of ours"
    )
    return program(tmp_path, code)


@pytest.fixture
def classifiers(tmp_path: Path) -> list[Path]:
    """The example, and what follows the documentation of the bare protocol."""
    return [EXAMPLE, page_program(tmp_path)]


def test_the_graph_completes_where_there_is_no_classifier_and_one_that_comes_after_the_end_gets_all_views(
    live: Callable[..., Live], classifiers: list[Path]
) -> None:
    graph = live()
    graph.until(lambda: graph.carved() == VIEWS, "the carver has all views")
    late = [graph.start(path, 0) for path in classifiers]
    for one in late:
        graph.until(one.got(VIEWS), "a late classifier has every view")
        assert len(one.stamps()) == VIEWS, "each once"
    graph.until(lambda: graph.carved() == VIEWS and bool(late[0].over()), "it learns that the run is over")
    assert late[0].over() == [str(graph.measurements.run_ns)]


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_a_classifier_that_is_there_from_the_beginning_gets_all_views_however_slow_it_is(
    live: Callable[..., Live], classifiers: list[Path], seconds: float
) -> None:
    graph = live(sub_aperture={"min_sinks": 4})
    outside = [graph.start(path, seconds) for path in classifiers]
    for one in outside:
        graph.until(one.got(VIEWS), "the classifier has every view")
    graph.until(lambda: graph.carved() == VIEWS, "the carver has every view")
    for one, node in zip(outside, ("classifier", "bare_classifier"), strict=True):
        assert len(one.stamps()) == VIEWS, "each once"
        graph.until(lambda node=node: len(graph.told(node)) == VIEWS, "every view is reported")
        assert set(graph.told(node).values()) == {"integrated"}


def test_a_classifier_that_is_killed_and_restarted_in_mid_run_gets_all_views(
    live: Callable[..., Live], classifiers: list[Path]
) -> None:
    graph = live(sub_aperture={"min_sinks": 4})
    first = [graph.start(path, 0.2) for path in classifiers]
    for one in first:
        graph.until(one.got(10), "it is mid-run")
    for one in first:
        one.kill()
        assert len(set(one.stamps())) < VIEWS
    second = [graph.start(path, 0) for path in classifiers]
    for one in second:
        graph.until(one.got(VIEWS), "the successor has every view")
        assert len(one.stamps()) == VIEWS, "each once"
    graph.until(lambda: graph.carved() == VIEWS, "the carver has every view")


def test_a_classifier_that_joins_in_mid_run_gets_all_views(
    live: Callable[..., Live], classifiers: list[Path]
) -> None:
    # The slow one holds the run up until the other two are there.
    graph = live(sub_aperture={"min_sinks": 3})
    renamed = EXAMPLE.read_text(encoding="utf-8").replace('"classifier"', '"slow_one"')
    slow = graph.start(program(graph.folder / "slow", renamed), 0.3)
    graph.until(slow.got(10), "it is mid-run")
    late = [graph.start(path, 0) for path in classifiers]
    for one in (*late, slow):
        graph.until(one.got(VIEWS), "it has every view")
        assert len(one.stamps()) == VIEWS, "each once"


def test_a_classifier_that_is_ended_in_order_says_goodbye_and_nobody_waits_for_it(
    live: Callable[..., Live],
) -> None:
    graph = live(sub_aperture={"min_sinks": 3, "sink_wait_s": 86400.0})
    outside = graph.start(EXAMPLE, 0.2)
    graph.until(outside.got(10), "it is mid-run")
    outside.end()
    assert len(outside.stamps()) < VIEWS
    graph.until(lambda: graph.carved() == VIEWS, "the run ends without it")
    beats = graph.beats
    graph.until(lambda: beats["classifier", "shadow"].values.get("leaving") == "true", "its goodbye is heard")


#: Takes the place of `shadow_likelihood`; refuses every ninth view in one way, and every ninth in another.
STAGE = """
    import sys
    import numpy as np
    import rclpy
    from csas_shadow_ros.client import ViewSubscriber, spin

    def classify(pixels, info):
        # By the view, not by how many came: a sink that appears late has views sent again.
        number = round(np.degrees(info.aspect_rad) / 5.0)
        print(f"{info.stamp_ns} classified", flush=True)
        if REFUSE and number % 9 == 0:
            return "too few pixels"
        if REFUSE and number % 9 == 1:
            raise ValueError("network is out of memory")
        dark = pixels < 0.35 * np.nanmedian(pixels)
        return dark if sys.argv[1] == "shadow_mask" else np.where(dark, 0.1, 0.9) + 0.0 * pixels

    rclpy.init()
    node = rclpy.create_node("network", namespace="csas")
    with ViewSubscriber(node, "shadow", classify, results=sys.argv[1]):
        spin(node)
"""


def test_a_goodbye_is_heard_by_a_node_that_has_no_processor_just_then(live: Callable[..., Live]) -> None:
    graph = live(sub_aperture={"min_sinks": 3, "sink_wait_s": 86400.0})
    outside = graph.start(EXAMPLE, 0.2)
    graph.until(outside.got(10), "it is mid-run")
    busy = graph.graph.processes["sub_aperture"].pid
    os.kill(busy, signal.SIGSTOP)
    threading.Timer(0.6, os.kill, (busy, signal.SIGCONT)).start()
    outside.end()
    graph.until(lambda: graph.carved() == VIEWS, "the run ends without it")


@pytest.mark.parametrize(
    ("stream", "begun"),
    [
        ("shadow_mask", 1),
        pytest.param("shadow_mask", 2, marks=pytest.mark.long),
        pytest.param("shadow_mask", 5, marks=pytest.mark.long),
        pytest.param("likelihood", 1, marks=pytest.mark.long),
    ],
)
def test_the_results_of_an_outside_stage_are_carved_and_the_graph_completes_though_it_is_killed(
    live: Callable[..., Live], tmp_path: Path, stream: str, begun: int
) -> None:
    method = "consensus" if stream == "shadow_mask" else "soft"
    graph = live(shadow_likelihood=None, voxel_carver={"method": method})
    path = program(tmp_path, STAGE.replace("REFUSE", "False"))
    first = graph.start(path, stream)
    graph.until(first.got(begun), "it has begun")
    first.kill()
    second = graph.start(path, stream)
    graph.until(lambda: graph.carved() == VIEWS, "the carver has every view")
    graph.until(lambda: graph.measurements is not None and graph.measurements.final, "there is a result")
    assert graph.measurements.views_used == VIEWS
    assert len({*first.stamps(), *second.stamps()}) == VIEWS
    # The first may have been killed between a result, which was carved, and its report: it need not come.
    alone = {int(stamp) for stamp in {*second.stamps()} - {*first.stamps()}}
    graph.until(lambda: alone <= {*graph.told("network")}, "every view of the second is reported")
    assert set(graph.told("network").values()) == {"published"}


@pytest.mark.long
def test_a_replay_without_a_stage_carves_what_ones_own_makes_in_its_place(
    run_bag: Path, tmp_path: Path
) -> None:
    code = """
        import numpy as np, rclpy
        from csas_shadow_ros.client import ViewSubscriber, create_node, spin
        from csas_shadow_ros.core.imaging.segmentation import segment_shadow
        from csas_shadow_ros.core.parameters import LikelihoodParameters
        from csas_shadow_ros.core.imaging.likelihood import outside_likelihood, view_levels
        from csas_shadow_ros.core.geometry import View

        def look(pixels, info):
            view, p = View(info, pixels), LikelihoodParameters()
            return outside_likelihood(view, p, view_levels(view, p)).pixels

        rclpy.init()
        node = create_node("own", namespace="csas")
        with ViewSubscriber(node, "shadow", look, results="likelihood", on_finished=lambda run: print(run)):
            spin(node)
    """
    with DomainReservation() as domain:
        environment = graph_environment(domain, tmp_path)
    environment.pop("CSAS_PARENT_PID", None)
    own = subprocess.Popen([sys.executable, program(tmp_path, code)], env=environment)
    try:
        made = replay(
            run_bag,
            tmp_path / "out",
            parameters(step_deg=15, voxel_size_m=VOXEL_M, method="soft"),
            domain_id=int(environment["ROS_DOMAIN_ID"]),
            without=["shadow_likelihood"],
            record=True,
            progress=False,
        )
    finally:
        own.send_signal(signal.SIGINT)
        own.wait(20.0)
    assert "shadow_likelihood" not in made.nodes
    assert (made.views_used, made.lost, made.not_recorded) == (24, 0, [])
    assert made.dimensions is not None


def test_a_replay_that_lacks_ones_own_stage_says_so_and_ends(run_bag: Path, tmp_path: Path) -> None:
    told: list[str] = []

    expected = r"nobody published likelihood or shadow_mask in ROS domain \d+ for 8 s"
    with pytest.raises(ReplayError, match=expected):
        replay(
            run_bag,
            tmp_path / "out",
            parameters(step_deg=15, voxel_size_m=VOXEL_M),
            without=["shadow_likelihood"],
            record=False,
            progress=False,
            notice=told.append,
            stall_timeout_s=8.0,
        )

    assert len(told) == 1
    assert "waiting for your node in place of shadow_likelihood" in told[0]


def test_views_that_an_outside_stage_refuses_or_fails_at_are_named_and_nobody_waits_for_them(
    live: Callable[..., Live], tmp_path: Path
) -> None:
    graph = live(shadow_likelihood=None)
    text = STAGE.replace("REFUSE", "True")
    graph.start(program(tmp_path, text), "shadow_mask")
    graph.until(lambda: len(graph.told("network")) == VIEWS, "every view is reported")
    told = list(graph.told("network").values())
    reasons = ("too few pixels", "ValueError: network is out of memory")
    refused = [told.count(f"rejected: {reason}") for reason in reasons]
    assert min(refused) > 0, told
    graph.until(lambda: graph.carved() == VIEWS - sum(refused), "the carver has all others, and ends")
    log = (graph.folder / "outside_0.log").read_text()
    assert log.count("the callback failed at the view stamped") == 1, "once for the line that fails"
    assert "Traceback" in log


def test_what_cannot_be_subscribed_to_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"stream is 'image'; expected one of: sub_aperture, shadow"):
        ViewSubscriber(None, "image", lambda *_: None)
    with pytest.raises(ParameterError, match=r"results is 'shadow_mask'; expected one of the streams behind"):
        ViewSubscriber(None, "likelihood", lambda *_: None, results="shadow_mask")


WAITS = """
import rclpy
from csas_shadow_ros.client import create_node

rclpy.init()
node = create_node("classifier", namespace="csas")
print("there", flush=True)
rclpy.spin(node)
"""


def test_a_node_that_was_killed_comes_back_at_ports_that_nobody_writes_to(graph: Any, tmp_path: Path) -> None:
    graph.plain_node("onlooker")
    environment = graph_environment(graph.domain_id, tmp_path)
    taken: list[set[str]] = []
    for _ in range(2):
        with subprocess.Popen(
            [sys.executable, "-c", WAITS], env=environment, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
            taken.append({name for name in owned_files(process.pid) if "_port" in name})
            deadline = time.monotonic() + 60
            while not all(name in Path("/proc/self/maps").read_text() for name in taken[-1]):
                assert time.monotonic() < deadline, "the onlooker writes to it"
                graph.executor.spin_once(timeout_sec=0.05)
            process.kill()
    assert len(taken[0]) == len(taken[1]) == 2
    # Ports of 70xx are of all domains: a graph beside this test may have freed the dead node's number.
    both = {name for name in taken[0] & taken[1] if "_port70" not in name}
    assert not both


def test_a_node_that_waits_names_a_process_whose_port_another_has_replaced(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What such a process latches reaches nobody that begins later, and nothing else says why."""
    monkeypatch.setattr(hearing, "_DEAF_LOOK_S", 0.5)
    told: list[str] = []
    kind = RclpyMessages().cls(TOPICS["/diagnostics"].type_name)
    listener = graph.plain_node("listener")
    listener.create_subscription(
        kind, "/diagnostics", lambda msg: told.append(msg.status[0].message), qos.DIAGNOSTICS
    )
    graph.add(SubApertureNode)
    environment = graph_environment(graph.domain_id, tmp_path)
    with subprocess.Popen(
        [sys.executable, "-c", WAITS], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
            graph.spin_until(lambda: len(told) > 3)
            assert set(told) == {"waiting for image and track"}
            ports = {name for name in owned_files(process.pid) if "_port" in name}
            for port in ports:
                Path(port).unlink()
                Path(port).write_bytes(b"made")  # by an unmade one any other test would be held up
            graph.spin_until(lambda: f"process {process.pid} (" in told[-1])
            assert told[-1].endswith("in shared memory that it reads; start it again")
        finally:
            process.kill()
    graph.spin_until(lambda: told[-1] == "waiting for image and track", what="it is gone")


def test_spinning_ends_once_it_is_to(graph: Graph) -> None:
    asked: list[int] = []

    def until() -> bool:
        asked.append(1)
        return len(asked) > 3

    node = rclpy.create_node("classifier", context=graph.context, namespace="csas")
    client.spin(node, 30.0, until=until)
    assert len(asked) == 4
    node.destroy_node()


def test_a_subscriber_that_hears_nobody_says_so_and_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, reference: Any
) -> None:
    class Lost:
        def is_lost(self) -> bool:
            return True

    monkeypatch.setattr(client, "Reach", Lost)
    told = in_one_process(lambda *_: time.sleep(1.5), [reference[1][0].shadow], beats=True)
    assert any(item.values.get("unable") == client.DEAF for item in told if isinstance(item, Heartbeat))


def in_one_process(
    callback: Callable[..., Any], views: Sequence[Any], results: str | None = None, *, beats: bool = False
) -> list[Any]:
    """Publish views to a subscriber in this process; return what it reports, or with `beats` all it says."""
    from csas_shadow_ros.core.geometry import View
    from msg_adapters import view_to_msgs

    messages, context, told = RclpyMessages(), Context(), []
    reservation = DomainReservation()
    rclpy.init(context=context, domain_id=reservation.domain_id)
    node = rclpy.create_node("classifier", context=context, namespace="csas")
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    image = node.create_publisher(messages.cls(TOPICS["shadow/image"].type_name), "shadow/image", qos.VIEWS)
    info = node.create_publisher(
        messages.cls(TOPICS["shadow/camera_info"].type_name), "shadow/camera_info", qos.VIEWS
    )
    kind = messages.cls(TOPICS["progress"].type_name)
    node.create_subscription(kind, "progress", lambda m: told.append(progress_from_msg(m)), qos.REPORTS)

    def spin(done: Callable[[], bool]) -> None:
        end = time.monotonic() + 30.0
        while not done():
            assert time.monotonic() < end, told
            executor.spin_once(timeout_sec=0.05)

    try:
        with ViewSubscriber(node, "shadow", callback, results=results) as made:
            assert isinstance(views[0], View)
            spin(lambda: image.get_subscription_count() > 0 and info.get_subscription_count() > 0)
            for number, view in enumerate(views, start=1):
                picture, camera = view_to_msgs(messages, view, "shadow")
                image.publish(picture)
                info.publish(camera)
                spin(lambda n=number: sum(not isinstance(t, Heartbeat) for t in told) >= n)
            made.close()
        spin(lambda: isinstance(told[-1], Heartbeat) and told[-1].values.get("leaving") == "true")
        return told if beats else [t for t in told if not isinstance(t, Heartbeat)]
    finally:
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.shutdown(context=context)
        reservation.close()


def test_a_view_that_comes_again_is_reported_again_and_not_classified_again(reference: Any) -> None:
    views = [v.shadow for v in reference[1][:2]]
    seen: list[int] = []
    told = in_one_process(lambda _, info: seen.append(info.stamp_ns), [views[0], views[1], views[0]])
    assert seen == [v.info.stamp_ns for v in views]
    assert [t.stamp_ns for t in told] == [views[n].info.stamp_ns for n in (0, 1, 0)]
    assert [t.outcome for t in told] == ["integrated"] * 3


@pytest.mark.parametrize(
    ("answer", "results", "reason"),
    [
        (lambda p, _: p, None, "TypeError: callback returned ndarray; expected None or a reason"),
        (lambda *_: None, "likelihood", "callback returned NoneType; expected the result's pixels or"),
        (lambda p, _: p[:-1] < 0, "shadow_mask", "view has "),
        (lambda p, _: p.astype(np.float32) * 0 + 2, "likelihood", "likelihood/image"),
        (lambda p, _: p, "shadow_mask", "TypeError: Cannot cast"),
    ],
)
def test_what_a_callback_must_not_return_refuses_the_view_with_a_line_that_says_so(
    reference: Any, answer: Callable[..., Any], results: str | None, reason: str
) -> None:
    (told,) = in_one_process(answer, [reference[1][0].shadow], results)
    assert told.outcome == "rejected"
    assert reason in told.reason
