"""One browser that looks on."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .once import Once
from .pace import Pace

if TYPE_CHECKING:
    import viser


@dataclass(slots=True, eq=False)
class Eye:
    """Where a browser's camera is, and the points that only it sees."""

    client: viser.ClientHandle
    pace: Pace = field(default_factory=Pace)
    detail: viser.PointCloudHandle | None = None
    drawn: Once = field(default_factory=Once)

    def moved(self) -> None:
        """The camera did: what a slow browser could not turn leaves at once."""
        self.pace.moved(time.monotonic())
        if self.pace.slow and self.detail is not None:
            self.detail.visible = False
