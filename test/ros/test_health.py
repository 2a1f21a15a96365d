"""Diagnostics: what is counted, how bad it is, what is said."""

from __future__ import annotations

import pytest

from deworldsg_ros.ros.health import ERROR, INTERNAL_ERROR, OK, WARN, Health


def test_nothing_yet() -> None:
    report = Health("graphs").report(0.0)
    assert (report.level, report.message) == (OK, "0.0 graphs a second")
    assert report.values == {"graphs a second": "0.0", "total": "0"}


def test_rates_are_those_since_the_last_report() -> None:
    health = Health("graphs")
    health.report(10.0)
    for _ in range(20):
        health.received("rgb")
    for _ in range(10):
        health.published(0.010)
    report = health.report(12.0)
    assert report.message == "5.0 graphs a second"
    assert report.values["received rgb"] == "10.0 a second, 20 in all"
    assert report.values["latency mean ms"] == "10.0"
    quiet = health.report(13.0)
    assert quiet.values["graphs a second"] == "0.0"
    assert quiet.values["total"] == "10"
    assert quiet.values["received rgb"] == "0.0 a second, 20 in all"
    assert "latency mean ms" not in quiet.values


def test_latency_percentile() -> None:
    health = Health("graphs")
    for latency_ms in range(1, 101):
        health.published(latency_ms / 1000)
    assert float(health.report(0.0).values["latency p95 ms"]) == pytest.approx(95.0, abs=0.2)


def test_a_drop_warns_once_and_stays_in_the_total() -> None:
    health = Health("graphs")
    health.dropped("no_pose", 3, "there is no pose\nand more")
    report = health.report(1.0)
    assert report.level == WARN
    assert report.message.endswith("; dropped 3 no_pose: there is no pose")
    assert report.values["why no_pose"] == "there is no pose"
    later = health.report(2.0)
    assert (later.level, later.values["dropped no_pose"]) == (OK, "3")
    assert health.drops == {"no_pose": 3}


def test_a_faster_stream_is_no_cause_for_alarm() -> None:
    health = Health("graphs")
    health.dropped("unmatched_depth", 20)
    report = health.report(1.0)
    assert (report.level, report.values["dropped unmatched_depth"]) == (OK, "20")


def test_waiting_is_the_message() -> None:
    report = Health("graphs").report(1.0, ["no camera_info on /x for 3 s", "no pose on /y for 3 s"])
    assert report.level == WARN
    assert report.message == "no camera_info on /x for 3 s; no pose on /y for 3 s"
    assert report.values["waiting for 2"] == "no pose on /y for 3 s"


def test_what_nobody_foresaw_is_an_error() -> None:
    health = Health("graphs")
    health.dropped(INTERNAL_ERROR)
    assert health.report(1.0).level == ERROR


def test_objects_left_out_are_told_without_alarm() -> None:
    health = Health("graphs")
    health.left_out({"few_mask_pixels": 2})
    health.left_out({"few_mask_pixels": 1})
    report = health.report(1.0, values={"queue": "4"})
    assert report.level == OK
    assert report.values["objects left out few_mask_pixels"] == "3"
    assert report.values["queue"] == "4"
