"""The controls beside the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import viser

from deworldsg_ros.view.colours import QUIET
from deworldsg_ros.view.live.details import image_html, note_html
from deworldsg_ros.view.live.state import LiveState

NONE = "none"
# On a phone the image is small, so that the panel does not cover the scene.
IMAGE_STYLE = (
    "<style>@media (max-width:600px) {.deworldsg-camera img {max-height:11vh}}</style>"
    '<div class="deworldsg-camera" style="padding:0 .8em">'
)


class Panel:
    """The controls of a viewer. A change calls `change` with a function that changes the state.

    Args:
        server: of viser.
        change: runs a function while the state is locked, and draws again.
        fit: moves the camera of a client so that it sees everything.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        change: Callable[[Callable[[LiveState], None]], None],
        fit: Callable[[Any], None],
    ) -> None:
        self._change = change
        self._gui = gui = server.gui
        self._server = server
        self._note = gui.add_html("")
        self._add_time()
        self._object = gui.add_html("", visible=False)
        self._deselect = gui.add_button("Deselect", visible=False)
        self._deselect.on_click(lambda _: change(lambda state: setattr(state, "selected", None)))
        self._camera = gui.add_html("", visible=False)
        self._add_show(fit)
        self._add_filters()

    def _add_time(self) -> None:
        self._slider = self._gui.add_slider(
            "Update", min=0, max=1, step=1, initial_value=1, visible=False,
            hint="the graph after each recorded update",
        )  # fmt: skip
        self._newest = self._gui.add_button("Back to the newest", visible=False)
        self._slider.on_update(self._slid)
        self._newest.on_click(lambda _: self._change(lambda state: setattr(state, "moment", None)))

    def _add_show(self, fit: Callable[[Any], None]) -> None:
        gui = self._gui
        view_all = gui.add_button("View everything")
        # Open, the folders would cover the scene on a phone.
        with gui.add_folder("Show", expand_by_default=False):
            self.shape = gui.add_dropdown("Objects", ("boxes", "ellipsoids"))
            self.labels = gui.add_checkbox("Labels", True)
            self.points = gui.add_checkbox("Surface points", True)
            self.camera = gui.add_checkbox("Camera", True)
            self.floor = gui.add_checkbox("Floor grid", True)
            dark = gui.add_checkbox("Dark", False)
        self.shape.on_update(
            lambda _: self._change(lambda state: setattr(state, "shape", self.shape.value))
        )
        for box in (self.labels, self.points, self.camera, self.floor):
            box.on_update(lambda _: self._change(lambda state: None))
        dark.on_update(lambda _: set_theme(self._server, dark.value))
        view_all.on_click(lambda event: fit(event.client))

    def _add_filters(self) -> None:
        gui = self._gui
        with gui.add_folder("Filter", expand_by_default=False):
            least = gui.add_slider(
                "Objects ≥", min=0, max=1, step=0.05, initial_value=0,
                hint="least probability that it exists and is of its class",
            )  # fmt: skip
            least_relation = gui.add_slider(
                "Relations ≥", min=0, max=1, step=0.05, initial_value=0,
                hint="least probability of a relation",
            )  # fmt: skip
            self._predicates = _Names(gui, "Predicates", QUIET, self._filter)
            self._classes = _Names(gui, "Classes", frozenset(), self._filter)
        least.on_update(lambda _: self._filter(min_probability=least.value))
        least_relation.on_update(lambda _: self._filter(min_relation=least_relation.value))

    def show(self, state: LiveState, lines: Sequence[str], selected: str) -> None:
        """Show the state.

        Args:
            state: the state.
            lines: above the controls.
            selected: HTML of the selected object; empty = none.
        """
        _set(self._note, content=note_html(lines))
        _set(self._object, content=selected, visible=bool(selected))
        _set(self._deselect, visible=bool(selected))
        first, last = state.history.first, state.history.last
        _set(self._slider, min=first, max=max(last, first + 1), visible=last > first)
        moment = last if state.moment is None else state.moment
        if last > first and self._slider.value != moment:
            self._slider.value = moment
        _set(self._newest, visible=state.moment is not None)
        self._classes.show(Counter(state.table.labels))
        self._predicates.show(Counter(edge.predicate for edge in state.edges.values()))

    def show_image(self, jpeg_file: bytes) -> None:
        """Show the image of the camera; empty = none."""
        html = image_html(jpeg_file, "image of the camera with the masks of the objects")
        _set(self._camera, content=f"{IMAGE_STYLE}{html}</div>", visible=bool(html))

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # and not the viewer itself
            self._change(self._choose_moment)

    def _choose_moment(self, state: LiveState) -> None:
        chosen = int(self._slider.value)
        state.moment = None if chosen >= state.history.last else chosen

    def _filter(self, **values: Any) -> None:
        if not values:
            values = {
                "hidden_classes": self._classes.hidden,
                "hidden_predicates": self._predicates.hidden,
            }
        self._change(lambda state: setattr(state, "filter", replace(state.filter, **values)))


class _Names:
    """A checkbox for each name that has appeared, with the number of its uses.

    Attributes:
        hidden: names that are not checked, among them some that have not appeared.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        hidden: Iterable[str],
        changed: Callable[[], None],
    ) -> None:
        self.hidden = frozenset(hidden)
        self._gui = gui
        self._changed = changed
        self._boxes: dict[str, Any] = {}
        with gui.add_folder(title, expand_by_default=False) as self._folder:
            switch = gui.add_button_group("Show", ("all", NONE))
        switch.on_click(lambda _: self._switch(switch.value == NONE))

    def show(self, counts: Mapping[str, int]) -> None:
        """Show the numbers of the names."""
        with self._folder:
            for name in sorted(counts.keys() - self._boxes.keys()):
                box = self._gui.add_checkbox(name, name not in self.hidden)
                box.on_update(lambda event, name=name: self._ticked(event, name))
                self._boxes[name] = box
        for name, box in self._boxes.items():
            _set(box, label=f"{name} ({counts.get(name, 0)})")

    def _ticked(self, event: Any, name: str) -> None:
        if event.client is not None:
            self.hidden = self.hidden ^ {name} if self._is_stale(name) else self.hidden
            self._changed()

    def _is_stale(self, name: str) -> bool:
        return bool(self._boxes[name].value) == (name in self.hidden)

    def _switch(self, none: bool) -> None:
        self.hidden = frozenset(self._boxes) if none else frozenset()
        for box in self._boxes.values():
            box.value = not none
        self._changed()


def set_theme(server: viser.ViserServer, dark: bool) -> None:
    """Light or dark; nothing of the viewer is sent to other machines, so no button to share it."""
    server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)


def _set(handle: Any, **values: Any) -> None:
    """Assign what has changed: viser sends every assignment."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)
