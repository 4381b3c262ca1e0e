"""What the node has seen, counted: for the reasons of its silence and for ``/diagnostics``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from beacon_comm.core.events import NS_PER_S
from beacon_comm.ros.latency import CharacterLatency
from beacon_comm.ros.live import LiveReceiver, Step


@dataclass
class Traffic:
    """Counts of one second's look at the topic.

    Attributes:
        messages: event messages.
        bad_messages: of these, those that could not be read.
        characters: decoded characters.
        problems: what was wrong, by kind.
        longest_wait_s: longest time (s) that a message waited in the node's queue; of those that were read.
        longest_lag_s: longest time (s) from a message's arrival to what it gave being published.
        shed: messages that were shed.
    """

    messages: int = 0
    bad_messages: int = 0
    characters: int = 0
    problems: Counter[str] = field(default_factory=Counter)
    longest_wait_s: float = 0.0
    longest_lag_s: float = 0.0
    shed: int = 0

    @property
    def only_refused(self) -> bool:
        """Whether every message was a second camera's."""
        return 0 < self.messages == self.problems['refused_frames']

    def problem_text(self) -> str:
        """Return the kinds of problems and how often, most frequent first."""
        return ', '.join(f'{kind} ({count})' for kind, count in self.problems.most_common())


class Report:
    """Collects traffic between two looks, and totals."""

    def __init__(self) -> None:
        self.traffic = Traffic()
        self.totals: Counter[str] = Counter()
        self.latency = CharacterLatency()
        self._events = 0
        self._looked_ns: int | None = None

    def message(self, step: Step, waited_s: float) -> None:
        """Count one message that was handed on, good or bad."""
        self.traffic.messages += 1
        self.traffic.longest_wait_s = max(self.traffic.longest_wait_s, waited_s)
        if step.problem is not None:
            self.traffic.bad_messages += 1
            self.traffic.problems[step.problem_kind] += 1

    def published(self, lag_s: float) -> None:
        """Take notice of how long after a message's arrival (s) what it gave was out."""
        self.traffic.longest_lag_s = max(self.traffic.longest_lag_s, lag_s)

    def shed(self) -> None:
        """Count one message that was shed."""
        self.traffic.messages += 1
        self.traffic.shed += 1

    def characters(self, count: int) -> None:
        """Count characters that were published."""
        self.traffic.characters += count
        self.totals['characters'] += count

    def look(self, live: LiveReceiver, now_ns: int) -> tuple[Traffic, int, dict[str, object]]:
        """Return the traffic since the last look, its events, and all values for ``/diagnostics``."""
        traffic, self.traffic = self.traffic, Traffic()
        counts = live.counts
        events = counts['events'] - self._events
        seconds = (now_ns - self._looked_ns) / NS_PER_S if self._looked_ns is not None else 0.0
        self._events, self._looked_ns = counts['events'], now_ns
        tracks = live.beacons()
        states = Counter(track.state.name.lower() for track in tracks)
        values: dict[str, object] = {
            'messages_per_s': f'{traffic.messages / seconds:.1f}' if seconds > 0.0 else 'nan',
            'events_per_s': f'{events / seconds:.0f}' if seconds > 0.0 else 'nan',
            'characters_per_s': f'{traffic.characters / seconds:.1f}' if seconds > 0.0 else 'nan',
            'queue_lag_s': f'{traffic.longest_wait_s:.4f}',
            'lag_s': f'{traffic.longest_lag_s:.4f}',
            **self.latency.look(),
            'tracks': len(tracks),
            **{f'tracks_{state}': count for state, count in sorted(states.items())},
            'index_threshold': f'{live.index_threshold:.3g}',
            'slots_full': live.slots_full,
            'confirmed': ' '.join(map(str, live.confirmed)),
            **dict(sorted({**self.totals, **counts}.items())),
        }
        return traffic, events, values
