"""Section 5: the bytes a second that a robot may send: its share of Eq. (6), and its link.

How fast a link is shows in the tokens that others echo. Bytes that went out before a token arrived
before it, so their number, over the time from the first of them to the echo, is a rate that the
link is sure to carry. So a link that has become faster is noticed without trying: the rate goes up
as far as that shows to fit, and no further.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping

from .config import Config
from .model import AuthorId
from .sync import Peer

_AIM = 0.8  # of what a link carries: what it is given
_SHARED = 0.9  # of C_Th that is shared out: buckets may fill at one time
_LISTEN = 2  # announcement periods in which a newcomer says little
_SURE = 10  # looks in a row at which a larger share must have been due
_DEEPEST = 64  # the rate is never cut to less than this part of the cap
_LEAST = 500.0  # bytes/s, nor to less than this: announcements would come too seldom to steer by
_WORTH = 1.1  # by which the rate must be able to rise before it does
_HOLD = 100  # cycles after which a link that was full is tried with more, though nothing shows
_TRIAL = 2  # cycles that such a trial lasts at least
_ENOUGH = 0.75  # of the longest delay: where it ends, so that it does no harm
_SETTLE = 10  # longest delays, until what goes into a link shows at its other end, and is gone
_STEP = 1.25  # by which it raises the rate
_CUT = 0.25  # what is left of the rate where messages take too long, and ever longer
_LONGEST = 16  # times `_HOLD`: that trials wait for after many that have failed
_REMEMBERED = 256  # moments at which bytes went out, for the token that comes after them
_FULL = 0.7  # of the rate: who sends less learns nothing from a trial
_SHOWN = 16  # tokens whose evidence is remembered


class Traffic:
    """The bytes a second that a robot may send: Eq. (6), and what its link is seen to carry."""

    def __init__(self, config: Config) -> None:
        limits, self._every = config.overhead, config.sync.announce_period
        fleet, own = limits.fleet_bytes_per_second, limits.robot_bytes_per_second
        self._fleet = math.inf if fleet is None else fleet
        self._own = math.inf if own is None else own
        self.rate = min(self._fleet / 16, self._own)  # until it is known who else is there
        self.most = min(self._fleet, self._own)  # bytes/s that no five seconds may exceed
        self._cap = math.inf
        self._first = self._next = -math.inf
        self._fits = 0  # looks in a row at which the share was larger than the cap
        self._link = Link(limits.longest_delay)

    def due(self, now: float) -> bool:
        """Whether it is time to look at the network again."""
        return now >= self._next

    def sent(self, now: float, sent: int) -> None:
        """So many bytes have gone out by now, in all."""
        self._link.sent(now, sent)

    def announced(self, now: float, token: int, sent: int) -> None:
        """A token goes out after so many bytes."""
        self._link.announced(now, token, sent)

    def look(
        self,
        now: float,
        peers: Mapping[AuthorId, Peer],
        delay: float | None,
        period: float | None,
    ) -> float:
        """The rate from now on. delay: s one way; period: T, s."""
        if self._first == -math.inf:
            self._first = now
        self._next = now + self._every
        if self._fleet < math.inf and now < self._first + _LISTEN * self._every:
            return self.rate  # first hear who is there
        self._share(1 + len(peers))
        self._link.look(now, peers, delay or 0.0, period or self._every, self._cap)
        self.rate = min(self._cap, self._link.rate)
        return self.rate

    def _share(self, robots: int) -> None:
        """Eq. (6): C_Th is shared by the N_G live robots; less at once, more after a while."""
        share = min(self._own, _SHARED * self._fleet / robots)
        self.most = min(self._own, self._fleet / robots)
        self._fits = self._fits + 1 if share > self._cap else 0
        if share < self._cap or self._fits > _SURE:
            self._cap, self._fits = share, 0


class Link:
    """What one robot's link carries. Without any sign that it is too slow: whatever is given."""

    def __init__(self, longest_delay: float) -> None:
        self.rate = math.inf  # bytes/s that it is given
        self._longest = longest_delay
        self._delay = 0.0
        self._congested = False
        self._out: deque[tuple[float, int]] = deque(maxlen=_REMEMBERED)  # bytes before a moment
        self._seen = (-math.inf, 0)  # at the last look: when, and bytes sent by then
        self._said: OrderedDict[int, tuple[float, int]] = OrderedDict()  # the same, of tokens
        self._shown: deque[float] = deque(maxlen=_SHOWN)  # bytes/s that it carries at least
        self._hold = math.inf  # when more is tried
        self._wait = float(_HOLD)  # cycles, after a trial that fails
        self._trial = -math.inf  # when the trial that runs ends
        self._good = 0.0  # the rate that was known to fit before it
        self._settled = -math.inf  # until then the delay is that of the last trial
        self._too_much = 0.0  # the rate at which the last one was given up
        self._used = 0  # bytes sent when the rate was last changed
        self._since = -math.inf  # then

    def sent(self, now: float, sent: int) -> None:
        """So many bytes have gone out by now: all since the last time, not before that time."""
        if sent != self._seen[1]:
            self._out.append(self._seen)
        self._seen = now, sent

    def announced(self, now: float, token: int, sent: int) -> None:
        """A token goes out now, after so many bytes."""
        self.sent(now, sent)
        self._said[token] = now, sent
        while len(self._said) > 64:
            self._said.popitem(last=False)

    def look(
        self, now: float, peers: Mapping[AuthorId, Peer], delay: float, period: float, cap: float
    ) -> None:
        """Set the rate. delay: s one way, now; period: T, s; cap: bytes/s that are sent at most."""
        self._measure(peers.values())
        before, self._delay = self._delay, delay
        if now < self._trial and delay > _ENOUGH * self._longest:
            self._give_up(now, period)
        elif delay > self._longest:
            if now >= self._settled:
                self._relieve(now, delay >= before, cap)
        elif self._congested:
            self._congested, self._good, self._wait = False, self.rate, float(_HOLD)
            self._hold = now + _HOLD * period
        elif self.rate < cap:
            self._raise(now, period)
        else:
            self.rate = math.inf

    def _measure(self, peers: Iterable[Peer]) -> None:
        """The evidence of the swiftest new echo: what the link carried at least before it came."""
        echoes = [peer.echo for peer in peers if peer.echo is not None]
        news = [echo for echo in echoes if echo.token in self._said]
        swiftest = min(news, key=lambda echo: (echo.delay, echo.token), default=None)
        if swiftest is None:
            return
        at, sent = self._said.pop(swiftest.token)
        came = at + 2 * swiftest.delay  # the way back counted too, so that it is sure
        rates = ((sent - size) / max(came - since, 1e-3) for since, size in self._out)
        self._shown.append(max((rate for rate in rates if rate > 0), default=0.0))

    def _relieve(self, now: float, grows: bool, cap: float) -> None:
        """Messages take too long: send much less, as long as they do not come sooner."""
        if not self._congested:  # what was seen before counts no more
            self._shown.clear()
            self._out.clear()
            self._congested, self._too_much = True, 0.0
        if grows:
            least = min(cap, max(_LEAST, cap / _DEEPEST))
            self._change(now, max(least, _CUT * min(self.rate, cap)))

    def _raise(self, now: float, period: float) -> None:
        """As far as two tokens show that it fits; else, seldom, a little further to see."""
        fits = _AIM * sorted(self._shown)[-2] if len(self._shown) > 1 else 0.0
        if fits > max(_WORTH * self.rate, self._too_much):
            self._change(now, fits)
            self._good, self._hold = fits, now + self._wait * period
        elif now >= self._hold:
            full = self._seen[1] - self._used > _FULL * self.rate * (now - self._since)
            self._change(now, _STEP * self.rate if full else self.rate)
            lasts = max(_TRIAL * period, _SETTLE * self._longest)
            self._trial = self._hold = now + lasts

    def _give_up(self, now: float, period: float) -> None:
        """A trial shows that no more fits: back, and not again for long."""
        self._too_much, self._trial = self.rate, -math.inf
        self._change(now, max(self._good, self.rate / _STEP**2))
        self._wait = min(2 * self._wait, _LONGEST * _HOLD)
        self._hold, self._settled = now + self._wait * period, now + _SETTLE * self._longest

    def _change(self, now: float, rate: float) -> None:
        self.rate, self._since, self._used = rate, now, self._seen[1]
