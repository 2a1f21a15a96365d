"""Models of a node that may raise, hang or be lost: their stage goes on without them.

Every call of a model runs in a thread of its own and has a time limit. A model that fails again and
again is loaded again, on the CPU. Faults can be injected, to try what the robot does then.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, TimeoutError
from dataclasses import dataclass
from typing import Any

from deworldsg_ros.scene.errors import ConfigurationError

PARTS = ("detector", "segmenter", "relation_head", "world_model")
# The slowest step of perception, a large network on a CPU, takes seconds.
PERCEPTION_LIMIT_S = 30.0
# A clip of the largest world model takes a minute on a CPU.
WORLD_MODEL_LIMIT_S = 300.0
# An image that a model cannot take is followed by others that it can: its model is not at fault.
RELOAD_AFTER_FAILURES = 3
# Between two attempts to load a model again, which takes seconds.
RELOAD_PERIOD_S = 5.0
# A call that takes longer than this many times its limit counts as hung. Python cannot end a
# thread: the process has to be started again.
HUNG_LIMITS = 2
# /diagnostics warns about a call that takes longer.
SLOW_S = 5.0
# Methods whose result a stage waits for.
CALLS = ("detect", "segment", "relate", "predict")


class ModelError(Exception):
    """A model hangs or is missing."""


@dataclass
class Faults:
    """Faults of one model, to come.

    Attributes:
        raises: number of calls that raise.
        hang_s: how long the next call takes.
        missing: None, or the number of failing attempts to load the model, which is lost at once.
    """

    raises: int = 0
    hang_s: float = 0.0
    missing: int | None = None

    def before_call(self) -> None:
        """Raise or hang."""
        if self.raises:
            self.raises -= 1
            raise RuntimeError("injected fault (debug.faults)")
        pause_s, self.hang_s = self.hang_s, 0.0
        time.sleep(pause_s)

    def before_load(self) -> None:
        """Raise while the model is missing."""
        if self.missing:
            self.missing -= 1
            raise ModelError("injected fault (debug.faults): it is not there")


def parse_faults(text: str) -> dict[str, Faults]:
    """Faults by part; raises ConfigurationError. The parameter `debug.faults` has the format."""
    faults = {part: Faults() for part in PARTS}
    for item in filter(None, text.replace(" ", "").split(",")):
        part, _, rest = item.partition(":")
        kind, _, amount = rest.partition(":")
        try:
            if kind == "raise":
                faults[part].raises = int(amount)
            elif kind == "hang":
                faults[part].hang_s = min(float(amount), threading.TIMEOUT_MAX)
            elif kind == "missing":
                faults[part].missing = int(amount)
            else:
                raise KeyError(kind)
        except (KeyError, ValueError) as error:
            raise ConfigurationError(
                f"parameter debug.faults has '{item}', expected PART:KIND:AMOUNT with a part of "
                f"{', '.join(PARTS)}; raise:CALLS, hang:SECONDS or missing:LOADS"
            ) from error
    return faults


class Supervised:
    """A model whose calls raise an exception rather than hang.

    Other attributes are those of the model. If a call takes longer than `limit_s`, it is abandoned;
    until it returns, further calls fail at once.

    Args:
        name: for messages.
        model: detector, segmenter, relation head or world model.
        limit_s: maximum time of a call.
        reload: loads the model again and calls `replace`; it may raise.
        faults: injected ones.
    """

    def __init__(
        self,
        name: str,
        model: Any,
        limit_s: float,
        reload: Callable[[], None],
        faults: Faults,
    ) -> None:
        self._name = name
        self._model = model
        self._limit_s = limit_s
        self._reload = reload
        self._faults = faults
        self._lost = faults.missing is not None
        self._failures = 0
        self._tried_s = -RELOAD_PERIOD_S
        self._error = ""
        self._call: Future[Any] | None = None
        self._since_s = 0.0
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        # A daemon: a model that never returns cannot keep the process alive.
        threading.Thread(target=self._serve, name=name, daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        if name not in CALLS:
            return getattr(self._model, name)
        return lambda *arguments: self._watch(name, arguments)

    def replace(self, model: Any) -> None:
        """Use another model from now on."""
        self._faults.before_load()
        self._model, self._lost, self._failures = model, False, 0

    def hung(self) -> str:
        """What is wrong with a model that never returns, in words; "" = it may return."""
        call, busy_s = self._call, time.monotonic() - self._since_s
        if call is None or call.done() or busy_s < HUNG_LIMITS * self._limit_s:
            return ""
        return (
            f"the {self._name} ({type(self._model).__name__}) has given no result for "
            f"{busy_s:.0f} s: start the node again"
        )

    def problem(self) -> str:
        """What is wrong, in words; "" = nothing."""
        if hung := self.hung():
            return hung
        call, busy_s = self._call, time.monotonic() - self._since_s
        if call is not None and busy_s > SLOW_S:
            return f"the {self._name} has given no result for {busy_s:.0f} s"
        return f"the {self._name} fails: {self._error}" if self._error else ""

    def _watch(self, name: str, arguments: tuple[Any, ...]) -> Any:
        call = self._call
        if call is not None:
            if not call.done():
                raise ModelError(self.problem() or f"the {self._name} is busy")
            self._call = None
        try:
            self._load_again()
            result = self._run(lambda: self._called(name, arguments))
        except Exception as error:
            self._failures += 1
            self._error = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise
        self._failures, self._error = 0, ""
        return result

    def _called(self, name: str, arguments: tuple[Any, ...]) -> Any:
        self._faults.before_call()
        return getattr(self._model, name)(*arguments)

    def _load_again(self) -> None:
        """Load a model that is lost or fails; at most every RELOAD_PERIOD_S."""
        now_s = time.monotonic()
        if self._lost or self._failures >= RELOAD_AFTER_FAILURES:
            if now_s - self._tried_s >= RELOAD_PERIOD_S:
                self._tried_s = now_s
                self._reload()
            elif self._lost:
                raise ModelError(f"the {self._name} is not there")

    def _run(self, function: Callable[[], Any]) -> Any:
        call: Future[Any] = Future()
        self._call, self._since_s = call, time.monotonic()
        self._calls.put((call, function))
        try:
            result = call.result(self._limit_s)
        except TimeoutError as error:
            if call.done():  # the model itself raised it
                self._call = None
                raise
            raise ModelError(f"no result in {self._limit_s:g} s: the call is abandoned") from error
        except Exception:
            self._call = None
            raise
        self._call = None
        return result

    def _serve(self) -> None:
        while True:
            call, function = self._calls.get()
            try:
                call.set_result(function())
            except BaseException as error:
                call.set_exception(error)
