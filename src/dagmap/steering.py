"""Section 5 at work: what an agent inserts, seals and sends passes here, and is held back where the
controller says so."""

from __future__ import annotations

from collections.abc import Iterable

from . import messages
from .config import Config
from .issuance import Allowance
from .messages import Heads, Message
from .model import AuthorId, Event, Outgoing
from .observing import Observing, Settled
from .overhead import Controller
from .quantising import QuantisedCycle
from .shaping import Shaper, Urgency
from .sync import Post, Sync


class Steering:
    """The controller and the way out of one agent."""

    def __init__(self, config: Config, me: AuthorId) -> None:
        self._config, self._me = config, me
        self.controller = Controller(config)
        self.shaper = Shaper(self.controller.most)
        self.shaper.rate = self.controller.rate

    def insert(
        self, observing: Observing, cycle: QuantisedCycle, now: float, settled: Settled
    ) -> list[Event]:
        """Algorithm 1 for a cycle, and for what was left of others, as far as there is time."""
        waiting, before = len(observing.backlog), len(observing.graph)
        events = self.controller.cycle(now, before, waiting, observing.backlog.dropped)
        observing.graph.n_c, limit = self.controller.n_c, self.controller.features
        observing.insert(cycle, now, settled, limit)
        fits = waiting if limit is None else limit - len(cycle.points)
        observing.catch_up(settled, fits)
        self.controller.work.inserted += len(observing.graph) - before
        return events

    def catch_up(self, observing: Observing, now: float, settled: Settled) -> list[Event]:
        """Where the SLAM pauses, what was left for later has its turn."""
        if not self.controller.overdue(now):
            return []
        waiting, before = len(observing.backlog), len(observing.graph)
        events = self.controller.idle(now, before, waiting, observing.backlog.dropped)
        observing.graph.n_c, limit = self.controller.n_c, self.controller.features
        observing.catch_up(settled, waiting if limit is None else limit)
        self.controller.work.inserted += len(observing.graph) - before
        return events

    def allowance(self, now: float) -> Allowance | None:
        """What may be sealed now; None: nothing."""
        room = self.shaper.room(now)
        features = self.controller.sendable(room)
        if room == 0 or features == 0:
            return None
        per_bundle = self.controller.per_bundle(self._config.issuance.features_per_bundle)
        usual = Allowance(per_bundle=per_bundle)
        if features is None:
            return usual
        # records are measured by what they take at most, three times what they usually do
        most = usual.room if room is None else min(usual.room, 3 * room)
        return Allowance(features, per_bundle, most)

    def post(self, posts: Iterable[Post], urgency: Urgency) -> None:
        """Send, as soon as there is room."""
        for post in posts:
            self.shaper.put(self._encoded(*post), urgency)

    def announce(self, sync: Sync, now: float, unread: bool) -> None:
        """Announcements, and questions for what is lacking."""
        found = list(sync.tick(now, unread))
        heads = [message for message, _ in found if isinstance(message, Heads)]
        said = [self._encoded(message, None) for message in heads]
        if said and self.shaper.announce(said, now):
            self.controller.announced(now, heads[0].token, self.shaper.sent)
        elif said:
            sync.unsaid(heads[0].token)
        self.post((post for post in found if not isinstance(post[0], Heads)), Urgency.CONTROL)

    def look(self, sync: Sync, now: float) -> None:
        """See who is there and how long messages take; send as much as that allows."""
        if self.controller.looks(now, self.shaper.sent):
            self.controller.look(now, sync.live(now), sync.delay(now))
            self.shaper.rate, self.shaper.cap = self.controller.rate, self.controller.most

    def _encoded(self, message: Message, to: AuthorId | None) -> Outgoing:
        return Outgoing(messages.encode(message, self._config, self._me), to)
