"""The worker's thread: frames never wait for it, and it stops. Locks order the events, not time."""

from __future__ import annotations

import threading

import pytest
from support.relations import GatedModel, RecordingModel, config, crowd_graph, pair_graph, picture

from deworldsg_ros.relations import EvidenceWorker, RelationReasoner

LONG_S = 30.0


class Receiver:
    """Collects what the worker delivers, and the threads in which it does."""

    def __init__(self):
        self.evidence = []
        self.threads = set()

    def __call__(self, evidence):
        self.evidence.append(evidence)
        self.threads.add(threading.get_ident())


def worker_of(model, receiver, report=lambda _: None, queue_size=8):
    reasoner = RelationReasoner(config(), model, report, queue_size=queue_size)
    return EvidenceWorker(reasoner, receiver, report)


def test_delivers_every_prediction_in_its_own_thread():
    receiver = Receiver()
    worker = worker_of(RecordingModel(), receiver, queue_size=100)
    worker.start()
    try:
        for stamp in range(3):
            assert not worker.observe(crowd_graph(stamp, 4), picture(stamp)).predicted.any()
        assert worker.wait_idle(LONG_S)
    finally:
        assert worker.stop(LONG_S)
    assert len(receiver.evidence) == 18 and all(e.predicted.all() for e in receiver.evidence)
    assert threading.get_ident() not in receiver.threads


def test_a_slow_world_model_delays_no_frame_and_lost_clips_are_counted():
    model, receiver = GatedModel(), Receiver()
    worker = worker_of(model, receiver, queue_size=2)
    worker.start()
    try:
        worker.observe(pair_graph(0), picture(0))
        assert model.begun.acquire(timeout=LONG_S)
        for stamp in range(1, 6):  # the model holds the first clip all the while
            assert len(worker.observe(pair_graph(stamp), picture(stamp)).pairs) == 2
        assert receiver.evidence == [] and not worker.wait_idle(0.01)
        counters = worker.reasoner.counters()
        assert counters.pending == 2 and counters.dropped == {"queue_full": 3}
        for _ in range(3):
            model.allowed.release()
        assert worker.wait_idle(LONG_S)
    finally:
        model.allowed.release()
        assert worker.stop(LONG_S)
    assert [evidence.stamp_ns for evidence in receiver.evidence] == [0, 5, 4]


def test_stop_returns_though_the_world_model_hangs_and_nothing_is_delivered_after_it():
    model, receiver = GatedModel(), Receiver()
    worker = worker_of(model, receiver)
    worker.start()
    worker.observe(pair_graph(0), picture(0))
    worker.observe(pair_graph(1), picture(1))
    assert model.begun.acquire(timeout=LONG_S)
    assert not worker.stop(0.05)
    for _ in range(2):
        model.allowed.release()
    assert worker.stop(LONG_S)
    assert receiver.evidence == [] and worker.reasoner.counters().pending == 0


def test_stop_of_an_idle_worker_and_of_one_never_started():
    idle, unused = (worker_of(RecordingModel(), Receiver()) for _ in range(2))
    idle.start()
    assert idle.stop(LONG_S) and idle.stop(LONG_S)
    assert unused.stop(LONG_S)


def test_a_worker_without_a_world_model_is_idle():
    worker = EvidenceWorker(RelationReasoner(config(world_model="none"), None), Receiver())
    worker.start()
    try:
        assert len(worker.observe(pair_graph(0), picture(0)).pairs) == 2
        assert worker.wait_idle(LONG_S)
    finally:
        assert worker.stop(LONG_S)


class FailsAtFirst(RecordingModel):
    """A model that fails on its first clip."""

    def predict(self, request):
        if not self.requests:
            self.requests.append(request)
            raise RuntimeError("not loaded yet")
        return super().predict(request)


def observe_one_by_one(worker, frames):
    worker.start()
    try:
        for stamp in range(frames):
            worker.observe(pair_graph(stamp), picture(stamp))
            assert worker.wait_idle(LONG_S)
    finally:
        assert worker.stop(LONG_S)


def test_the_worker_survives_failures_of_world_model_and_receiver():
    reports, delivered = [], []

    def deliver(evidence):
        if evidence.stamp_ns == 1:
            raise RuntimeError("publisher is gone")
        delivered.append(evidence)

    worker = worker_of(FailsAtFirst(), deliver, reports.append)
    observe_one_by_one(worker, 3)
    assert [evidence.stamp_ns for evidence in delivered] == [2]
    assert reports == [
        "world model 'fake' failed: RuntimeError: not loaded yet",
        "evidence was not delivered: RuntimeError: publisher is gone",
    ]


@pytest.mark.parametrize("observers", [3])
def test_many_threads_may_observe(observers):
    receiver = Receiver()
    worker = worker_of(RecordingModel(), receiver, queue_size=64)
    worker.start()

    def observe(first):
        for stamp in range(first, first + 2):
            worker.observe(pair_graph(stamp), picture(stamp))

    threads = [threading.Thread(target=observe, args=(2 * n,)) for n in range(observers)]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LONG_S)
        assert worker.wait_idle(LONG_S)
    finally:
        assert worker.stop(LONG_S)
    counters = worker.reasoner.counters()
    assert counters.queued == counters.encoded + sum(counters.dropped.values())
    assert len(receiver.evidence) == counters.encoded


def test_an_unexpected_error_of_the_reasoner_does_not_end_the_thread(monkeypatch):
    reports, receiver = [], Receiver()
    worker = worker_of(RecordingModel(), receiver, reports.append)
    work, calls = worker.reasoner.work, []

    def fail_once():
        calls.append(0)
        if len(calls) == 1:
            raise IndexError("a mistake")
        return work()

    monkeypatch.setattr(worker.reasoner, "work", fail_once)
    observe_one_by_one(worker, 2)
    assert len(receiver.evidence) == 2
    assert reports == ["a clip was not judged: IndexError: a mistake"]
