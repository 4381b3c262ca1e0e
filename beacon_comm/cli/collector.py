"""Gathers what a receiver gives out over a recording: one account a track, kept when the track is lost."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.character import Character
from beacon_comm.core.receiver import BeaconSnapshot, Output, Receiver
from beacon_comm.evaluation.result import BeaconResult, PathPoint


@dataclass(slots=True)
class _Account:
    track_id: int
    state: BeaconState = BeaconState.WAITING
    confirmed_at_ns: int | None = None
    bit_rate_bps: float | None = None
    azimuth_rad: float | None = None
    elevation_rad: float | None = None
    path: list[PathPoint] = field(default_factory=list)
    received: list[tuple[Character, int]] = field(default_factory=list)
    confirmed_seen_ns: int | None = None

    @property
    def silent(self) -> bool:
        return not self.received and self.confirmed_at_ns is None

    def result(self) -> BeaconResult:
        received = sorted(self.received, key=lambda one: one[0].t_ns)
        return BeaconResult(
            track_id=self.track_id,
            state=self.state,
            confirmed_at_ns=self.confirmed_at_ns,
            bit_rate_bps=self.bit_rate_bps,
            azimuth_rad=self.azimuth_rad,
            elevation_rad=self.elevation_rad,
            path=tuple(self.path),
            characters=tuple(character for character, _ in received),
            received_ns=tuple(at_ns for _, at_ns in received),
            confirmed_seen_ns=self.confirmed_seen_ns,
        )


class Collector:
    """Accounts of all tracks, in recording time.

    Attributes:
        origin_ns: sensor time at recording time 0; changes where a sensor is restarted.
    """

    def __init__(self, origin_ns: int = 0) -> None:
        self.origin_ns = origin_ns
        self._accounts: dict[int, _Account] = {}
        self._instants_ns: list[int] = []

    @property
    def instants_ns(self) -> NDArray[np.int64]:
        """When the tracks were sampled (recording time, ns), increasing, ``(n,)`` int64."""
        return np.array(self._instants_ns, np.int64)

    def take(self, output: Output, receiver: Receiver) -> None:
        """Take what a push, a flush or a restart gave."""
        now_ns = (receiver.t_ns or 0) - self.origin_ns
        for received in output.characters:
            character = replace(received.character, t_ns=received.character.t_ns - self.origin_ns)
            self._account(received.track_id).received.append((character, now_ns))
        for snapshot in output.lost:
            self._note(snapshot)
        if output.confirmed_changed:
            for snapshot in receiver.beacons():
                account = self._note(snapshot)
                if snapshot.state is BeaconState.CONFIRMED and account.confirmed_seen_ns is None:
                    account.confirmed_seen_ns = now_ns

    def sample(self, receiver: Receiver) -> None:
        """Take all tracks as they are now: a point of their paths."""
        now_ns = (receiver.t_ns or 0) - self.origin_ns
        if not self._instants_ns or self._instants_ns[-1] < now_ns:
            self._instants_ns.append(now_ns)
        for snapshot in receiver.beacons():
            t_ns = snapshot.t_ns - self.origin_ns
            path = self._note(snapshot).path
            if not path or path[-1].t_ns < t_ns:
                path.append(_point(snapshot, t_ns))

    def beacons(self) -> tuple[tuple[BeaconResult, ...], tuple[BeaconResult, ...]]:
        """Return the tracks that gave characters or were confirmed, by label, and the others."""
        accounts = [account for _, account in sorted(self._accounts.items())]
        speaking = tuple(account.result() for account in accounts if not account.silent)
        return speaking, tuple(account.result() for account in accounts if account.silent)

    def whole_signal(self) -> BeaconResult:
        """Return everything as one beacon: a recording without pixels holds no other."""
        accounts = [account for _, account in sorted(self._accounts.items())]
        if not accounts:
            return _Account(track_id=1).result()
        confirmed_ns = [account.confirmed_at_ns for account in accounts if account.confirmed_at_ns is not None]
        seen_ns = [account.confirmed_seen_ns for account in accounts if account.confirmed_seen_ns is not None]
        rates = [account.bit_rate_bps for account in accounts if account.bit_rate_bps is not None]
        whole = _Account(
            accounts[0].track_id,
            accounts[-1].state,
            min(confirmed_ns, default=None),
            rates[-1] if rates else None,
            received=[received for account in accounts for received in account.received],
            confirmed_seen_ns=min(seen_ns, default=None),
        )
        return whole.result()

    def _account(self, track_id: int) -> _Account:
        return self._accounts.setdefault(track_id, _Account(track_id))

    def _note(self, snapshot: BeaconSnapshot) -> _Account:
        account = self._account(snapshot.track_id)
        account.state = snapshot.state
        if snapshot.bit_rate_bps is not None:
            account.bit_rate_bps = snapshot.bit_rate_bps
        if account.confirmed_at_ns is None and snapshot.confirmed_at_ns is not None:
            account.confirmed_at_ns = snapshot.confirmed_at_ns - self.origin_ns
        if snapshot.azimuth_rad is not None:
            account.azimuth_rad, account.elevation_rad = snapshot.azimuth_rad, snapshot.elevation_rad
        return account


def _point(snapshot: BeaconSnapshot, t_ns: int) -> PathPoint:
    return PathPoint(
        t_ns,
        snapshot.x_px,
        snapshot.y_px,
        snapshot.extent_px,
        snapshot.state is BeaconState.CONFIRMED,
        snapshot.quiet,
        snapshot.azimuth_rad,
        snapshot.elevation_rad,
        _upper(getattr(snapshot, 'pixel_covariance', None)),
        _upper(getattr(snapshot, 'angle_covariance', None)),
    )


def _upper(covariance: tuple[tuple[float, float], tuple[float, float]] | None) -> tuple[float, float, float] | None:
    if covariance is None:
        return None
    (xx, xy), (_, yy) = covariance
    return xx, xy, yy
