"""Work ahead of its use: the same items in the same order, bounded, and ended with its consumer."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future

import pytest

from deworldsg_ros.pipeline import apply_ahead, read_ahead


def wait_until(condition) -> None:  # type: ignore[no-untyped-def]
    for _ in range(500):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("it did not happen within 5 s")


def of_this_module() -> list[str]:
    return [t.name for t in threading.enumerate() if "_ahead" in t.name]


@pytest.mark.parametrize("count", [0, 1, 20])
def test_all_items_come_in_order(count: int) -> None:
    assert list(read_ahead(iter(range(count)), 2)) == list(range(count))
    results = [(item, future.result()) for item, future in apply_ahead(str, range(count), 3)]
    assert results == [(item, str(item)) for item in range(count)]
    assert of_this_module() == []


def test_reading_is_in_another_thread_and_bounded() -> None:
    taken: list[int] = []
    threads = set()

    def items() -> Iterator[int]:
        for item in range(100):
            threads.add(threading.current_thread())
            taken.append(item)
            yield item

    ahead = read_ahead(items(), 2)
    assert next(ahead) == 0
    # One is used, two wait, and the thread holds one more.
    wait_until(lambda: len(taken) == 4)
    time.sleep(0.05)
    assert len(taken) == 4 and threading.current_thread() not in threads
    ahead.close()  # type: ignore[attr-defined]
    assert of_this_module() == []


def test_an_error_of_the_items_comes_after_the_items_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise OSError("the disk is gone")

    seen = []
    with pytest.raises(OSError, match="the disk is gone"):
        for item in read_ahead(items(), 5):
            seen.append(item)
    assert seen == [1, 2]


def test_an_error_of_the_function_belongs_to_its_item() -> None:
    def halve(item: int) -> int:
        if item % 2:
            raise ValueError(f"{item} is odd")
        return item // 2

    def outcome(future: Future[int]) -> int | str:
        return str(future.exception()) if future.exception() else future.result()

    found = [(item, outcome(future)) for item, future in apply_ahead(halve, range(4), 2)]
    assert found == [(0, 0), (1, "1 is odd"), (2, 1), (3, "3 is odd")]


def test_the_function_runs_for_several_items_at_the_same_time_and_not_for_all() -> None:
    together = threading.Barrier(2, timeout=5)
    started: list[int] = []

    def meet(item: int) -> int:
        started.append(item)
        together.wait()
        return item

    pairs = apply_ahead(meet, range(40), 2)
    assert next(pairs)[1].result(timeout=5) == 0
    # Of four items that were handed over at most, none is left without its partner.
    wait_until(lambda: len(started) == 4)
    time.sleep(0.05)
    assert sorted(started) == [0, 1, 2, 3]
    pairs.close()  # type: ignore[attr-defined]


def test_an_interrupt_of_the_consumer_ends_all_threads() -> None:
    started: list[int] = []

    def slow(item: int) -> int:
        started.append(item)
        time.sleep(0.05)
        return item

    with pytest.raises(KeyboardInterrupt):
        for item, _ in apply_ahead(slow, read_ahead(iter(range(1000)), 2), 2):
            if item == 3:
                raise KeyboardInterrupt
    wait_until(lambda: of_this_module() == [])
    assert len(started) < 12
