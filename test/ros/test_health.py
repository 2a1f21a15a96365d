"""Diagnostics: counts, levels, messages, and their way back from /diagnostics."""

from unittest.mock import Mock

import pytest

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
    observations_of,
    received_in,
)
from deworldsg_ros.ros.node import DropLog


@pytest.fixture
def health() -> Health:
    return Health("graphs")


def test_rates_and_latencies_cover_the_time_since_the_last_report(health):
    first = health.report(10.0)
    assert (first.level, first.message) == (OK, "0.0 graphs per second")
    assert first.values == {"graphs per second": "0.0", "total": "0"}
    for latency_ms in range(1, 101):
        health.received("rgb")
        health.published(latency_ms / 1000)
    report = health.report(12.0)
    assert report.message == "50.0 graphs per second"
    assert report.values["received rgb"] == "50.0 per second, 100 in total"
    assert report.values["latency mean ms"] == "50.5"
    assert float(report.values["latency p95 ms"]) == pytest.approx(95.0, abs=0.2)
    quiet = health.report(13.0).values
    assert quiet == {
        "graphs per second": "0.0",
        "total": "100",
        "received rgb": "0.0 per second, 100 in total",
    }


def test_a_drop_warns_once_and_stays_in_the_total(health):
    health.dropped("no_pose", 3, "there is no pose\nand more")
    report = health.report(1.0)
    assert report.level == WARN
    assert report.message.endswith("; dropped 3 no_pose: there is no pose")
    assert report.values["example no_pose"] == "there is no pose"
    later = health.report(2.0)
    assert (later.level, later.values["dropped no_pose"]) == (OK, "3")
    assert health.drops == {"no_pose": 3}


@pytest.mark.parametrize(
    ("happens", "level"),
    [
        (lambda health: health.dropped("unmatched_depth", 20), OK),
        (lambda health: health.left_out({"few_mask_pixels": 2}), OK),
        (lambda health: health.dropped(INTERNAL_ERROR), ERROR),
    ],
)
def test_other_levels(health, happens, level):
    happens(health)
    assert health.report(1.0).level == level


def test_missing_inputs_are_the_message_and_counts_are_read_back(health):
    missing = ["no camera_info on /x for 3 s", "no pose on /y for 3 s"]
    report = health.report(1.0, missing, values={"queue": "4"})
    assert (report.level, report.message) == (WARN, "; ".join(missing))
    assert report.values["waiting for 2"] == missing[1]
    assert report.values["queue"] == "4"
    health.dropped("no_pose", 2, "no pose near 3.0 s")
    for count in (1, 3):
        health.left_out({"few_mask_pixels": count})
        health.received("rgb")
    values = health.report(1.0).values
    assert counts_in(values, DROPPED) == {"no_pose": 2}
    assert counts_in(values, LEFT_OUT) == {"few_mask_pixels": 4}
    assert (received_in(values, "rgb"), received_in(values, "depth")) == (2, 0)


@pytest.mark.parametrize("value", ["many", "", "-3", "9" * 5000])
def test_what_is_no_count_is_left_out(value):
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


def test_the_log_of_drops_shows_text_of_others_as_text():
    logger = Mock()
    log = DropLog(logger)
    log.write("invalid_request", "query: 'a\x1b[2J\n[INFO] all is well'")
    log.write(INTERNAL_ERROR, "bad \x1b[2J\nTraceback")
    logger.warning.assert_called_once_with(
        "invalid_request: query: 'a\\u001b[2J\\u000a[INFO] all is well'"
    )
    logger.error.assert_called_once_with(f"{INTERNAL_ERROR}: bad \\u001b[2J\nTraceback")
