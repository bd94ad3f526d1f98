"""Flow control without ROS: what a source sends, when, and when it is done."""

from __future__ import annotations

import random

import pytest

from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.nodes.runtime.flow import Flow
from msg_adapters import Heartbeat, ViewProgress


class Clock:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Consumer:
    """A consumer that reports to a flow."""

    def __init__(
        self,
        flow: Flow,
        node: str = "voxel_carver",
        role: str = "sink",
        stream: str = "likelihood",
        n: int = 1,
        **values: str,
    ) -> None:
        self.flow, self.node, self.role, self.stream = flow, node, role, stream
        self.instance = f"{node}-{n}"
        self.beat(**values)

    def beat(self, **values: str) -> None:
        values = {"input": self.stream, **values}
        self.flow.heard(Heartbeat(0, self.node, self.instance, self.role, {}, values))

    def report(self, stamp: int, reason: str = "", **more: str) -> None:
        outcome = "rejected" if reason else "integrated" if self.role == "sink" else "published"
        values = {"role": self.role, "input": self.stream, **more}
        self.flow.heard(ViewProgress(stamp, self.node, self.instance, outcome, reason, values=values))


def make_flow(count: int = 20, stream: str = "sub_aperture", **options: float) -> tuple[Flow, Clock]:
    clock = Clock()
    options = {"settle_s": 0.0, **options}
    flow = Flow(stream, clock=clock, **options)  # type: ignore[arg-type]
    flow.offer(range(1, count + 1))
    return flow, clock


def take_all(flow: Flow) -> list[int]:
    """Take everything that may be sent now."""
    taken = []
    while (stamp := flow.next()) is not None:
        taken.append(stamp)
    return taken


def wait(flow: Flow, clock: Clock, seconds: float, *alive: Consumer) -> None:
    """Let time pass, with heartbeats."""
    end = clock.now + seconds
    while clock.now < end:
        clock.now += min(0.25, end - clock.now)
        for consumer in alive:
            consumer.beat()
        flow.look()


def test_never_more_views_on_their_way_than_the_window_and_all_get_through() -> None:
    flow, _ = make_flow(100, window=4)
    sink = Consumer(flow)
    flow.look()
    received: list[int] = []
    while not flow.finished:
        sent = take_all(flow)
        assert flow.in_flight <= 4
        received += sent
        sink.report(received[len(flow._reports.get(sink.instance, ()))])
    assert received == list(range(1, 101))
    assert flow.resends == 0
    assert list(flow.finished_for()) == [sink.instance]


def test_a_sink_that_restarts_gets_every_view_again_and_the_other_sink_does_not_hold_it_up() -> None:
    flow, clock = make_flow(6)
    carver, recorder = Consumer(flow), Consumer(flow, "bag_recorder", stream="shadow")
    flow.look()
    for _ in range(6):
        for stamp in take_all(flow):
            carver.report(stamp)
            recorder.report(stamp)
    assert flow.finished
    wait(flow, clock, 4.0, recorder)  # the carver is killed
    assert not flow.finished, "a sink that vanished is waited for"
    again = Consumer(flow, n=2)
    flow.look()
    got: list[int] = []
    while not flow.finished:
        sent = take_all(flow)
        got += sent
        for stamp in sent:
            again.report(stamp)
    assert got == [1, 2, 3, 4, 5, 6]
    assert set(flow.finished_for()) == {again.instance, recorder.instance}


def finish_run(flow: Flow, *sinks: Consumer) -> None:
    """Have every sink report every view."""
    for _ in range(100):
        if flow.finished:
            return
        for stamp in take_all(flow):
            for sink in sinks:
                sink.report(stamp)
    raise AssertionError(f"not finished: {flow.done} of {flow.total}, waiting for {flow.waiting_for()!r}")


def test_a_run_is_not_over_at_the_very_moment_when_a_killed_recorder_is_back() -> None:
    flow, clock = make_flow(6)
    carver, recorder = Consumer(flow), Consumer(flow, "bag_recorder")
    flow.look()
    finish_run(flow, carver, recorder)
    wait(flow, clock, 4.0, carver)  # the recorder is killed after its last report
    assert not flow.finished
    again = Consumer(flow, "bag_recorder", n=2)  # nobody has looked since
    assert not flow.finished, "its successor has reported nothing"
    assert again.instance not in set(flow.finished_for())
    finish_run(flow, carver, again)
    assert again.instance in set(flow.finished_for())


@pytest.mark.parametrize("stream", ["sub_aperture", "shadow", "likelihood", "shadow_mask"])
def test_a_recorder_that_does_not_know_yet_who_publishes_does_not_say_goodbye_for_its_predecessor(
    stream: str,
) -> None:
    flow, clock = make_flow(6)
    carver, recorder = Consumer(flow, stream="shadow_mask"), Consumer(flow, "bag_recorder", stream=stream)
    flow.look()
    for stamp in take_all(flow):
        carver.report(stamp)
        recorder.report(stamp)
    wait(flow, clock, 4.0, carver)  # killed: the carver alone gets the rest
    again = Consumer(flow, "bag_recorder", stream=stream, n=2, idle="true")
    again.report(1, idle="true")  # what it took over
    flow.look()
    for _ in range(6):
        for stamp in take_all(flow):
            carver.report(stamp)
    assert flow.in_flight == 0
    assert not flow.finished, "the only one who keeps the stream is not there yet"
    again.beat()
    flow.look()
    assert not flow.finished
    got = take_all(flow)
    for stamp in got:
        again.report(stamp)
    got += take_all(flow)
    assert got == [2, 3, 4, 5, 6]
    again.report(6)
    assert flow.finished


def test_a_recorder_whose_stream_nobody_publishes_is_waited_for_by_nobody() -> None:
    flow, _ = make_flow(6)
    carver = Consumer(flow)
    Consumer(flow, "bag_recorder", stream="shadow_mask", idle="true")
    flow.look()
    finish_run(flow, carver)
    assert list(flow.finished_for()) == [carver.instance]


def test_a_stage_that_restarts_gets_only_what_had_not_got_through() -> None:
    flow, clock = make_flow(6, window=2)
    sink = Consumer(flow)
    stage = Consumer(flow, "shadow_enhancement", "stage", "sub_aperture")
    flow.look()
    for stamp in take_all(flow):
        stage.report(stamp)
        sink.report(stamp)
    assert take_all(flow) == [3, 4]
    wait(flow, clock, 4.0, sink)  # the stage is killed with two views in its queue
    Consumer(flow, "shadow_enhancement", "stage", "sub_aperture", n=2)
    flow.look()
    assert take_all(flow) == [3, 4], "they are sent again at once"


def test_a_view_refused_by_a_stage_is_done_for_the_sinks_behind_it_only() -> None:
    flow, _ = make_flow(1)
    carver, recorder = Consumer(flow), Consumer(flow, "bag_recorder", stream="sub_aperture")
    stage = Consumer(flow, "shadow_enhancement", "stage", "sub_aperture")
    flow.look()
    assert take_all(flow) == [1]
    stage.report(1, "no finite pixel")
    assert not flow.finished, "the recorder of the stage's input has not reported it"
    recorder.report(1)
    assert flow.finished
    assert carver.instance in set(flow.finished_for())


def test_a_sink_refusal_speaks_for_that_sink_alone() -> None:
    flow, _ = make_flow(1)
    carver, recorder = Consumer(flow), Consumer(flow, "bag_recorder", stream="likelihood")
    flow.look()
    take_all(flow)
    carver.report(1, "no silhouette")
    assert not flow.finished
    recorder.report(1)
    assert flow.finished


def test_a_lost_view_is_sent_again_once_twice_the_window_has_overtaken_it() -> None:
    flow, _ = make_flow(30, window=4)
    sink = Consumer(flow)
    flow.look()
    sent: list[int] = []
    while 2 not in sent[2:]:
        fresh = take_all(flow)
        sent += fresh
        for stamp in fresh:
            if stamp != 2 or sent.count(2) > 1:
                sink.report(stamp)
        assert len(sent) < 30, "it was never sent again"
    assert flow.resends == 1


def test_a_lost_view_without_others_is_sent_again_after_a_time_that_grows() -> None:
    flow, clock = make_flow(2, window=1, resend_s=5.0)
    sink = Consumer(flow)
    flow.look()
    assert take_all(flow) == [1]
    sink.report(1)
    assert take_all(flow) == [2]
    for gap in (5.0, 10.0, 20.0):
        wait(flow, clock, gap - 0.5, sink)
        assert take_all(flow) == []
        wait(flow, clock, 1.0, sink)
        assert take_all(flow) == [2]


def test_a_view_that_vanishes_again_and_again_while_others_pass_is_lost_with_an_error() -> None:
    flow, _ = make_flow(200, window=4, max_attempts=3)
    sink = Consumer(flow)
    flow.look()
    while not flow.lost:
        for stamp in take_all(flow):
            if stamp != 7:
                sink.report(stamp)
        assert flow.in_flight <= 4
    assert list(flow.lost) == [7]
    assert any(level == "error" and "7 ns is lost" in text for level, text in flow.notes)
    while sent := take_all(flow):
        for stamp in sent:
            sink.report(stamp)
    assert flow.finished


def test_no_view_is_lost_however_long_a_stage_is_away_that_was_killed_after_others_got_through() -> None:
    flow, clock = make_flow(8, window=4, resend_s=1.0)
    carver = Consumer(flow, stream="shadow_mask")
    network = Consumer(flow, "network", "stage", "shadow")
    wait(flow, clock, 0.25, carver, network)
    assert take_all(flow) == [1, 2, 3, 4]
    carver.report(1)  # the last thing that the network did was to pass the first one on
    for _ in range(400):
        wait(flow, clock, 1.0, carver)
        take_all(flow)
    assert not flow.lost
    assert not flow.finished
    second = Consumer(flow, "network", "stage", "shadow", n=2)
    for _ in range(8):
        wait(flow, clock, 0.25, carver, second)
        for stamp in take_all(flow):
            second.report(stamp)
            carver.report(stamp)
    assert flow.finished
    assert flow.done == 8
    assert not flow.lost


def test_no_view_is_lost_because_consumers_begin_again_while_it_is_on_its_way() -> None:
    """Each that comes back has all views in flight sent at once: that a copy is under way says nothing."""
    flow, clock = make_flow(200, window=4)
    sink = Consumer(flow)
    flow.look()
    for begun in range(1, 9):
        recorder = Consumer(flow, "bag_recorder", n=begun)
        for _ in range(4):
            wait(flow, clock, 0.25, sink, recorder)
            for stamp in take_all(flow):
                if stamp != 3:
                    sink.report(stamp)
                    recorder.report(stamp)
        recorder.beat(leaving="true")
    assert not flow.lost, flow.notes


def test_no_view_is_lost_behind_a_stage_that_is_away_while_another_sink_gets_all_of_them_anew() -> None:
    """What passes by another way tells nothing of a view that waits for a stage that was killed."""
    flow, clock = make_flow(36, window=4)
    carver = Consumer(flow, stream="shadow_mask")
    network = Consumer(flow, "network", "stage", "shadow")
    composites = Consumer(flow, "composites", stream="sub_aperture")
    wait(flow, clock, 0.25, carver, network, composites)
    while flow.done < 34:
        for stamp in take_all(flow):
            composites.report(stamp)
            if stamp <= 34:  # the network is killed before the last two
                network.report(stamp)
                carver.report(stamp)
    composites.beat(leaving="true")
    second = Consumer(flow, "composites", stream="sub_aperture", n=2)
    for _ in range(40):
        wait(flow, clock, 0.25, carver, second)
        for stamp in take_all(flow):
            second.report(stamp)
    assert not flow.lost
    assert flow.done == 34
    third = Consumer(flow, "network", "stage", "shadow", n=2)
    for _ in range(8):
        wait(flow, clock, 0.25, carver, second, third)
        for stamp in take_all(flow):
            second.report(stamp)
            third.report(stamp)
            carver.report(stamp)
    assert flow.finished
    assert flow.done == 36


def test_a_view_that_was_given_up_is_sent_again_to_whoever_comes() -> None:
    flow, clock = make_flow(200, window=4, max_attempts=3)
    sink = Consumer(flow)
    flow.look()
    while not flow.lost:
        for stamp in take_all(flow):
            if stamp != 7:
                sink.report(stamp)
    Consumer(flow, "network", "stage", "shadow")
    assert not flow.lost
    sent: list[int] = []
    while not flow.finished:
        wait(flow, clock, 0.25, sink)
        for stamp in take_all(flow):
            sent.append(stamp)
            sink.report(stamp)
    assert 7 in sent, "it is not forgotten without a word"


def test_nothing_is_lost_while_a_stage_between_is_missing_however_long() -> None:
    flow, clock = make_flow(5, window=2)
    sink = Consumer(flow)
    flow.look()
    for _ in range(100):
        take_all(flow)
        wait(flow, clock, 30.0, sink)
    assert not flow.lost
    assert not flow.finished
    assert flow.in_flight == 2, "memory stays bounded"
    for _ in range(20):  # now the stage is there: everything passes
        wait(flow, clock, 25.0, sink)
        for stamp in take_all(flow):
            sink.report(stamp)
    assert flow.finished


def test_without_anybody_the_source_waits_and_then_ends_and_a_late_sink_still_gets_everything() -> None:
    flow, clock = make_flow(5, sink_wait_s=60.0)
    flow.look(subscribers=0)
    assert take_all(flow) == []
    assert flow.waiting_for() == "a consumer"
    clock.now += 61.0
    flow.look(subscribers=0)
    assert flow.finished
    assert list(flow.finished_for()) == []
    sink = Consumer(flow)
    flow.look()
    got = []
    while not flow.finished:
        for stamp in take_all(flow):
            got.append(stamp)
            sink.report(stamp)
    assert got == [1, 2, 3, 4, 5]


def test_consumers_that_report_nothing_are_served_a_window_at_a_time() -> None:
    flow, _ = make_flow(10, window=4)
    flow.look(subscribers=1)
    got = []
    while not flow.finished:
        sent = take_all(flow)
        assert len(sent) <= 4
        assert take_all(flow) == [], "the next window waits until the transport has delivered this one"
        got += sent
        assert flow.acknowledged_by_transport
        flow.transported()
    assert got == list(range(1, 11))


def test_the_last_stage_paces_the_source_where_no_sink_is() -> None:
    flow, _ = make_flow(3, window=1)
    first = Consumer(flow, "shadow_enhancement", "stage", "sub_aperture")
    last = Consumer(flow, "shadow_likelihood", "stage", "shadow")
    flow.look()
    assert take_all(flow) == [1]
    first.report(1)
    assert take_all(flow) == []
    last.report(1)
    assert take_all(flow) == [2]


def test_a_sink_that_leaves_in_an_orderly_way_is_waited_for_by_nobody() -> None:
    flow, _ = make_flow(3, window=1)
    carver, other = Consumer(flow), Consumer(flow, "bag_recorder", stream="shadow")
    flow.look()
    for stamp in (1, 2, 3):
        assert take_all(flow) == [stamp]
        carver.report(stamp)
        if stamp == 1:
            other.beat(leaving="true")
            flow.look()
    assert flow.finished


def test_a_vanished_only_sink_is_waited_for_so_long_and_no_longer() -> None:
    flow, clock = make_flow(3, sink_wait_s=20.0)
    sink = Consumer(flow)
    flow.look()
    for stamp in take_all(flow):
        sink.report(stamp)
    wait(flow, clock, 4.0)
    assert "voxel_carver to come back" in flow.waiting_for()
    assert not flow.finished
    wait(flow, clock, 25.0)
    assert any("did not come back" in text for _, text in flow.notes)
    assert not flow.waiting_for()


def test_a_sink_that_only_fetches_what_it_missed_is_not_waited_for_once_it_vanishes() -> None:
    flow, clock = make_flow(3, window=3, sink_wait_s=20.0)
    carver = Consumer(flow)
    flow.look()
    for stamp in take_all(flow):
        carver.report(stamp)
    viewer = Consumer(flow, "viewer", stream="shadow")
    viewer.beat(passing="true")
    flow.look()
    assert not flow.finished
    assert set(take_all(flow)) == {1, 2, 3}, "as long as it is there it gets what it lacks"
    wait(flow, clock, 4.0, carver)
    assert flow.finished
    assert not flow.waiting_for()


def test_a_source_that_was_busy_itself_does_not_take_its_consumers_for_gone() -> None:
    flow, clock = make_flow(3)
    Consumer(flow)
    flow.look()
    clock.now += 30.0
    flow.look()
    assert len(flow.sinks()) == 1


def test_a_restarted_source_sends_only_what_the_sinks_still_lack() -> None:
    flow, _ = make_flow(6)
    sink = Consumer(flow)
    for stamp in (1, 2, 3):  # kept reports, which arrive when the new source subscribes
        sink.report(stamp)
    flow.look()
    assert take_all(flow) == [4, 5, 6]


def test_a_source_listens_before_it_sends_so_that_it_knows_who_reports_what() -> None:
    flow, clock = make_flow(6, settle_s=1.0)
    flow.look(subscribers=1)
    assert take_all(flow) == []
    sink = Consumer(flow)
    for stamp in (1, 2, 3):
        sink.report(stamp)
    wait(flow, clock, 1.1, sink)
    assert take_all(flow) == [4, 5, 6]
    assert not flow.acknowledged_by_transport


@pytest.mark.parametrize("missing", ["", "stage", "sink"])
def test_a_source_listens_no_longer_once_all_are_there_that_it_waits_for(missing: str) -> None:
    flow, clock = make_flow(6, settle_s=1.0, min_sinks=2)
    flow.look(subscribers=2)
    Consumer(flow, "enhancement", role="stage", stream="sub_aperture").beat()
    if missing != "stage":
        Consumer(flow, "likelihood", role="stage", stream="shadow").beat()
    carver = Consumer(flow, "carver", stream="shadow_mask")
    if missing != "sink":
        Consumer(flow, "composites", stream="sub_aperture").beat()
    clock.now += 0.1
    carver.beat()
    assert flow.next() is None  # kept reports may still be on their way
    carver.report(1)
    clock.now += 0.15
    flow.look(subscribers=2)
    assert bool(take_all(flow)) == (not missing)


def test_a_sink_that_says_goodbye_in_mid_run_is_not_waited_for_though_it_was_counted_on() -> None:
    flow, clock = make_flow(6, min_sinks=2, sink_wait_s=86400.0)
    flow.look(subscribers=2)
    carver, classifier = (
        Consumer(flow, "carver", stream="shadow_mask"),
        Consumer(flow, "classifier", stream="shadow"),
    )
    wait(flow, clock, 1.1, carver, classifier)
    sent = take_all(flow)
    assert sent
    for stamp in sent:
        carver.report(stamp)
        classifier.report(stamp)
    classifier.beat(leaving="true")
    wait(flow, clock, 1.1, carver)
    assert take_all(flow)


def test_a_source_that_computed_meanwhile_reads_what_it_was_told_and_waits_no_longer() -> None:
    flow, clock = make_flow(6, settle_s=1.0)
    flow.look(subscribers=0)
    clock.now += 0.5
    flow.meet(subscribers=1)  # its heartbeats go on while it computes
    clock.now += 3.0
    flow.look(subscribers=1)
    assert take_all(flow) == []
    sink = Consumer(flow)
    for stamp in (1, 2, 3):
        sink.report(stamp)
    wait(flow, clock, 0.25, sink)
    assert take_all(flow) == [4, 5, 6]


def test_a_sector_source_counts_only_those_who_take_sectors() -> None:
    flow, _ = make_flow(1, stream="sector")
    Consumer(flow)
    taker = Consumer(flow, "sub_aperture", stream="sector")
    flow.look()
    assert take_all(flow) == [1]
    taker.report(1)
    assert flow.finished


def test_a_view_that_the_source_cannot_make_is_not_waited_for() -> None:
    flow, _ = make_flow(2)
    sink = Consumer(flow)
    flow.look()
    assert take_all(flow) == [1, 2]
    flow.refuse(2, "no image of that stamp")
    sink.report(1)
    assert flow.finished
    assert flow.refused == {2: "no image of that stamp"}


def test_the_window_must_be_at_least_one() -> None:
    with pytest.raises(ParameterError, match="window is 0"):
        make_flow(1, window=0)


@pytest.mark.parametrize("seed", range(5))
def test_every_view_gets_through_a_channel_that_loses_repeats_and_reorders(seed: int) -> None:
    rng = random.Random(seed)
    flow, clock = make_flow(60, window=4, resend_s=1.0, max_attempts=1000)
    number, sink = 1, Consumer(flow)
    got: set[int] = set()
    queue: list[int] = []
    for _ in range(100_000):
        if flow.finished:
            break
        clock.now += 0.1
        sink.beat()
        flow.look()
        if (stamp := flow.next()) is not None and rng.random() > 0.2:
            queue += [stamp] * rng.choice((1, 1, 2))
        assert flow.in_flight <= 4
        if queue and rng.random() < 0.5:
            stamp = queue.pop(rng.randrange(len(queue)))
            got.add(stamp)
            sink.report(stamp)
        if rng.random() < 0.002 and number < 4:  # the sink dies with all that it held, and comes back
            number += 1
            got, queue = set(), []
            sink = Consumer(flow, n=number)
            flow.peers[f"voxel_carver-{number - 1}"].alive = False
    assert got == set(range(1, 61))
    assert not flow.lost


def test_a_report_that_a_goodbye_has_overtaken_does_not_bring_the_consumer_back() -> None:
    flow, clock = make_flow(4)
    staying, leaving = Consumer(flow), Consumer(flow, "voxel_carver_2")
    flow.look()
    sent = take_all(flow)
    leaving.beat(leaving="true")
    leaving.report(sent[0])
    flow.look()
    assert [peer.node for peer in flow.live()] == ["voxel_carver"]
    for stamp in sent:
        staying.report(stamp)
    wait(flow, clock, 5.0, staying)
    assert flow.finished, "nobody waits for who has left"
    leaving.beat()
    assert len(flow.live()) == 2
    assert not flow.finished, "activated again, it gets what it lacks"
