"""Diagnostics: counts, levels, messages."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from deworldsg_ros.ros.diagnosed import observations_of
from deworldsg_ros.ros.health import (
    DROPPED,
    ERROR,
    INTERNAL_ERROR,
    LEFT_OUT,
    OK,
    WARN,
    Health,
    count_in,
    counts_in,
    received_in,
)
from deworldsg_ros.ros.node import DropLog


def test_a_report_before_the_first_message() -> None:
    report = Health("graphs").report(0.0)
    assert (report.level, report.message) == (OK, "0.0 graphs per second")
    assert report.values == {"graphs per second": "0.0", "total": "0"}


def test_rates_cover_the_time_since_the_last_report() -> None:
    health = Health("graphs")
    health.report(10.0)
    for _ in range(20):
        health.received("rgb")
    for _ in range(10):
        health.published(0.010)
    report = health.report(12.0)
    assert report.message == "5.0 graphs per second"
    assert report.values["received rgb"] == "10.0 per second, 20 in total"
    assert report.values["latency mean ms"] == "10.0"
    quiet = health.report(13.0)
    assert quiet.values["graphs per second"] == "0.0"
    assert quiet.values["total"] == "10"
    assert quiet.values["received rgb"] == "0.0 per second, 20 in total"
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
    assert report.values["example no_pose"] == "there is no pose"
    later = health.report(2.0)
    assert (later.level, later.values["dropped no_pose"]) == (OK, "3")
    assert health.drops == {"no_pose": 3}


def test_unmatched_messages_raise_no_warning() -> None:
    health = Health("graphs")
    health.dropped("unmatched_depth", 20)
    report = health.report(1.0)
    assert (report.level, report.values["dropped unmatched_depth"]) == (OK, "20")


def test_missing_inputs_are_the_message() -> None:
    report = Health("graphs").report(1.0, ["no camera_info on /x for 3 s", "no pose on /y for 3 s"])
    assert report.level == WARN
    assert report.message == "no camera_info on /x for 3 s; no pose on /y for 3 s"
    assert report.values["waiting for 2"] == "no pose on /y for 3 s"


def test_an_unexpected_exception_is_an_error() -> None:
    health = Health("graphs")
    health.dropped(INTERNAL_ERROR)
    assert health.report(1.0).level == ERROR


def test_objects_left_out_are_counted_without_a_warning() -> None:
    health = Health("graphs")
    health.left_out({"few_mask_pixels": 2})
    health.left_out({"few_mask_pixels": 1})
    report = health.report(1.0, values={"queue": "4"})
    assert report.level == OK
    assert report.values["objects left out few_mask_pixels"] == "3"
    assert report.values["queue"] == "4"


def test_counts_are_read_back_from_a_report() -> None:
    health = Health("graphs")
    health.dropped("no_pose", 2, "no pose near 3.0 s")
    health.left_out({"few_mask_pixels": 4})
    for _ in range(3):
        health.received("rgb")
    values = health.report(1.0).values
    assert counts_in(values, DROPPED) == {"no_pose": 2}
    assert counts_in(values, LEFT_OUT) == {"few_mask_pixels": 4}
    assert (received_in(values, "rgb"), received_in(values, "depth")) == (3, 0)


@pytest.mark.parametrize("value", ["many", "", "-3", "9" * 5000])
def test_what_is_no_count_is_left_out(value: str) -> None:
    values = {
        "dropped x": value,
        "dropped y": "2",
        "nodes": value,
        "received rgb": f"1.0 per second, {value} in total",
        f"frames turned by {value} degrees": "3",
        "frames turned by 90 degrees": value,
    }
    assert counts_in(values, DROPPED) == {"y": 2}
    assert (count_in(values, "nodes"), count_in(values, "edges")) == (0, 0)
    assert received_in(values, "rgb") == 0
    seen = observations_of({"a": values, "b": {"nodes": "4", "frames turned by 270 degrees": "5"}})
    assert (seen.nodes, seen.drops, +seen.turns) == (4, {"y": 2}, {3: 5})


def test_the_log_of_drops_shows_text_of_others_as_text() -> None:
    logger = Mock()
    log = DropLog(logger)
    log.write("invalid_request", "query: 'a\x1b[2J\n[INFO] all is well'")
    log.write(INTERNAL_ERROR, "bad \x1b[2J\nTraceback")
    logger.warning.assert_called_once_with(
        "invalid_request: query: 'a\\u001b[2J\\u000a[INFO] all is well'"
    )
    logger.error.assert_called_once_with(f"{INTERNAL_ERROR}: bad \\u001b[2J\nTraceback")
