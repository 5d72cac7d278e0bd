"""The panel beside the map: what a person can ask for, and the texts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...model import State
from .colouring import COLOURINGS

if TYPE_CHECKING:
    import viser

_SHOWN_AT_FIRST = (State.CONFIRMED, State.TENTATIVE)


class Controls:
    """Widgets are read when the view is drawn; what they show is set there too."""

    def __init__(self, gui: viser.GuiApi, points: int) -> None:
        """points: that are drawn of a map at most, at first."""
        self.standing = gui.add_html("")
        self.busy = gui.add_progress_bar(0.0, visible=False, animated=True)
        self.colouring = gui.add_dropdown("Colour by", COLOURINGS)
        self.legend = gui.add_html("")
        self.states = {
            state: gui.add_checkbox(state.name.capitalize(), state in _SHOWN_AT_FIRST)
            for state in State
        }
        self.counts = gui.add_html("")
        with gui.add_folder("Ledger"):
            self.slider = gui.add_slider("Transaction", 0, 1, 1, 1, disabled=True)
            self.latest = gui.add_checkbox(
                "Latest", True, hint="Show all transactions, and new ones as they arrive"
            )
            self.play = gui.add_checkbox("Play", False, hint="Let the ledger run from here")
            self.newest = gui.add_html("")
        with gui.add_folder("Picked point"):
            self.node = gui.add_html("")
        with gui.add_folder("Drawing"):
            self.size = gui.add_slider("Point size (mm)", 2, 100, 1, 20)
            self.points = gui.add_slider(
                "Points (1,000)", 10, 2000, 10, max(10, min(2000, points // 1000))
            )
            self.paths = gui.add_checkbox("Robots and paths", True)
            self.edges = gui.add_checkbox(
                "Adjacency graph", False, hint="Its edges about the picked point"
            )
            self.radius = gui.add_slider("Region (m)", 0.1, 5.0, 0.1, 1.0)

        self.slider.on_update(self._dragged)

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # a person's hand, not `offer`
            self.latest.value = self.slider.value >= self.slider.max

    @property
    def wanted_states(self) -> tuple[State, ...]:
        return tuple(state for state, box in self.states.items() if box.value)

    def offer(self, count: int) -> None:
        """So many transactions can be walked through; stay at the end where that is wanted."""
        if self.slider.max != max(count, 1):
            self.slider.max = max(count, 1)
        self.slider.disabled = count == 0
        if self.latest.value and self.slider.value != count:
            self.slider.value = count

    def wanted_count(self, count: int) -> int:
        """Up to which transaction the ledger is to be shown."""
        return count if self.latest.value else min(int(self.slider.value), count)

    def step(self, count: int) -> None:
        """Let the ledger run on where that is wanted; a whole one in some 20 s."""
        if not self.play.value:
            return
        begin = 0 if self.slider.value >= count else int(self.slider.value)
        at = min(count, begin + max(1, count // 100))
        self.latest.value = at >= count
        self.play.value = at < count
        self.slider.value = at
