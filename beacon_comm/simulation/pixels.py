"""The pixels that lights fall on, one by one, from irradiance to events.

    lights ─► I(t) = 1 + Σ strength · drive · shape          over the background's, inverse square law in ``lights``
           ─► ln I                                           the photoreceptor's response is logarithmic [Lichtsteiner 2008]
           ─► low-pass, τ = photoreceptor_us / (brightness · I)       faster in the light [Lichtsteiner 2008, Hu 2021]
           ─► + shot noise, rms ∝ 1/√(brightness · I)                 [Graça 2021, Hu 2021]
           ─► low-pass, τ = follower_us                               second pole [Hu 2021, Graça 2025]
           ─► y − reference ≥ θ_on: ON,  ≤ −θ_off: OFF                differencing, two comparators [Lichtsteiner 2008]
                │  θ differs from pixel to pixel (mismatch) and from event to event [Lichtsteiner 2008, Lin 2022]
                │  the reference leaks downwards: ON events at leak_hz [Nozaki 2017]
                ▼
           request; an event when the arbiter has come by (:mod:`~beacon_comm.simulation.scan`); then held in reset for
           refractory_us: what changes meanwhile is lost, and the reference is what y is at its end [Lichtsteiner 2008]

A pixel is simulated in steps of ``STEP_NS``, of several where its light hardly changes; a crossing's time is interpolated
within the step.  Only pixels that a light reaches, and those still settling behind one that moved on, are simulated: for
the rest of the sensor noise is drawn (:mod:`~beacon_comm.simulation.noise`).

The literature is listed in ``docs/simulator.md``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.simulation.description import SceneDescription, Sensor
from beacon_comm.simulation.lights import FLASHES, LEVELS, PROFILE_STEPS, PULSES, SINE, FlatLights, Light
from beacon_comm.simulation.scan import Scan, seen
from beacon_comm.simulation.trajectory import Floats

STEP_NS = 5_000
BLOCK_STEPS = 200
BLOCK_NS = STEP_NS * BLOCK_STEPS
_LONGEST_STRIDE = 20
_STRIDE_CHANGE = 0.02  # change of log irradiance that one step may hold: far below a threshold
_MOVED_PX = 0.05  # a light is moved on in steps of this
_SETTLED = 0.01  # log units: a pixel so near its resting level needs no simulation
_MOST_LIGHTS = 16  # that one pixel sees

RawEvents = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int8]]
"""Times (ns), columns, rows, polarities."""


class Mismatch:
    """What differs from pixel to pixel, drawn once for a sensor: thresholds and refractory times, ``(height, width)``."""

    def __init__(self, sensor: Sensor, random: np.random.Generator) -> None:
        shape = sensor.height, sensor.width
        spread = sensor.threshold_mismatch
        self.threshold_on = sensor.threshold_on * np.maximum(random.normal(1.0, spread, shape), 0.2)
        self.threshold_off = sensor.threshold_off * np.maximum(random.normal(1.0, spread, shape), 0.2)
        refractory = np.maximum(random.normal(1.0, sensor.refractory_mismatch, shape), 0.1)
        self.refractory_ns = sensor.refractory_us * 1e3 * refractory


class LitPixels:
    """The pixels under the lights; keeps their state from block to block."""

    def __init__(
        self,
        lights: list[Light],
        description: SceneDescription,
        mismatch: Mismatch,
        scan: Scan,
        random: np.random.Generator,
    ) -> None:
        sensor = description.sensor
        self._lights = FlatLights.of(lights)
        self._mismatch = mismatch
        self._scan = scan
        shape = sensor.height, sensor.width
        self._y1, self._y2, self._reference, self._free_ns = (np.zeros(shape) for _ in range(4))
        self._scale = np.ones(shape)
        self._awake = np.zeros(shape, np.uint8)
        self._awake_list = np.empty(0, np.int64)
        self._slot = np.full(shape, -1, np.int64)
        self._cursor = self._lights.changes_at[:-1].copy()
        self._drive_state = np.ones((len(lights), 2))
        self._random = np.array([random.integers(1, 2**63)], np.uint64)
        brightness = description.background.brightness
        self._physics = np.array(
            [
                brightness,
                sensor.photoreceptor_us * 1e3,
                sensor.follower_us * 1e3,
                sensor.photon_noise,
                sensor.threshold_noise,
                sensor.leak_hz * sensor.threshold_on * 1e-9,
            ]
        )
        self._none = not lights

    def block(self, begin_ns: int) -> RawEvents:
        """Return the events of the block that begins at ``begin_ns``, not in order; blocks come one after the other.

        The arbiter may see an event only after the block.
        """
        if self._none:
            return np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int8)
        lights = self._lights
        amplitude, strides = _amplitudes(
            begin_ns,
            lights.drive,
            lights.numbers,
            lights.changes_at,
            lights.changes_ns,
            lights.levels,
            self._cursor,
            self._drive_state,
            lights.strength_at,
            lights.strength_ns,
            lights.strength,
        )
        x_px, y_px, moves = _positions(begin_ns, lights.path_at, lights.path_ns, lights.path_x, lights.path_y)
        t_ns, x, y, polarity, count, self._awake_list = _pixels(
            begin_ns,
            amplitude,
            strides,
            x_px,
            y_px,
            moves,
            lights.profile,
            lights.reach_px,
            lights.half_px,
            self._mismatch.threshold_on,
            self._mismatch.threshold_off,
            self._mismatch.refractory_ns,
            self._y1,
            self._y2,
            self._reference,
            self._free_ns,
            self._scale,
            self._awake,
            self._awake_list,
            self._slot,
            self._physics,
            self._scan.begins_ns(begin_ns),
            self._scan.phase_ns,
            self._random,
        )
        return t_ns[:count], x[:count], y[:count], polarity[:count]


def threshold_radius(light: Light, sensor: Sensor) -> Floats:
    """Return the radius (px) within which a light's full swing passes the mean ON threshold, at its strength's knots."""
    distance = np.sqrt(np.linspace(0.0, light.reach_px**2, PROFILE_STEPS + 1))
    swing = np.log1p(light.strength[1][:, None] * light.profile)
    passed = swing >= sensor.threshold_on
    return np.where(passed.any(axis=1), distance[np.maximum(passed.sum(axis=1) - 1, 0)], 0.0)


@njit(cache=True, nogil=True)
def _amplitudes(begin_ns, drive, numbers, changes_at, changes_ns, levels, cursor, state, strength_at, strength_ns, strength):  # type: ignore[no-untyped-def]
    """Return irradiance in each light's middle at the end of each step ``(s, BLOCK_STEPS)``, and its longest stride."""
    count = len(drive)
    amplitude = np.empty((count, BLOCK_STEPS))
    strides = np.empty(count, np.int64)
    for s in range(count):
        if drive[s] == LEVELS:
            _led(begin_ns, numbers[s], changes_at[s], changes_at[s + 1], changes_ns, levels, cursor, state, s, amplitude[s])
        else:
            _periodic(begin_ns, drive[s], numbers[s], state, s, amplitude[s])
        k = strength_at[s] + np.searchsorted(strength_ns[strength_at[s] : strength_at[s + 1]], begin_ns, side='right')
        largest = 0.0
        before = amplitude[s, 0]
        for step in range(BLOCK_STEPS):
            t = begin_ns + (step + 1) * STEP_NS
            while strength_ns[k] <= t:
                k += 1
            share = (t - strength_ns[k - 1]) / (strength_ns[k] - strength_ns[k - 1])
            amplitude[s, step] *= strength[k - 1] + share * (strength[k] - strength[k - 1])
            now = amplitude[s, step]
            if step:
                largest = max(largest, abs(now - before) / (1.0 + min(now, before)))
            before = now
        stride = int(min(_STRIDE_CHANGE / max(largest, 1e-9), _LONGEST_STRIDE))
        while BLOCK_STEPS % max(stride, 1):
            stride -= 1
        strides[s] = max(stride, 1)
    return amplitude, strides


@njit(cache=True, nogil=True)
def _led(begin_ns, numbers, first, stop, changes_ns, levels, cursor, state, s, out):  # type: ignore[no-untyped-def]
    """Follow a line through the driver's slew (constant rate) and the LED's rise and fall (first order)."""
    delay, rise, fall, rise_slew, fall_slew = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    k = cursor[s]
    level = 1.0 if k == first else float(levels[k - 1])
    current, light = state[s, 0], state[s, 1]
    full_rise, full_fall = math.exp(-STEP_NS / rise), math.exp(-STEP_NS / fall)
    for step in range(BLOCK_STEPS):
        now = float(begin_ns + step * STEP_NS)
        end = now + STEP_NS
        while True:
            turns = k < stop and changes_ns[k] + delay < end
            until = max(changes_ns[k] + delay, now) if turns else end
            span = until - now
            before = current
            current += min(max(level - current, -span / fall_slew), span / rise_slew)
            if span == STEP_NS:
                kept = full_rise if level > 0.5 else full_fall
            else:
                kept = math.exp(-span / (rise if level > 0.5 else fall))
            middle = 0.5 * (before + current)
            light = middle + (light - middle) * kept
            now = until
            if not turns:
                break
            level = float(levels[k])
            k += 1
        out[step] = light
    cursor[s] = k
    state[s, 0], state[s, 1] = current, light


@njit(cache=True, nogil=True)
def _periodic(begin_ns, kind, numbers, state, s, out):  # type: ignore[no-untyped-def]
    frequency, phase = numbers[0], numbers[1]
    value = state[s, 0]
    for step in range(BLOCK_STEPS):
        turn = frequency * (begin_ns + (step + 1) * STEP_NS) + phase
        turn -= math.floor(turn)
        if kind == SINE:
            out[step] = 1.0 + numbers[2] * math.sin(2.0 * math.pi * turn)
        elif kind == PULSES:
            target = 1.0 if turn < numbers[2] else 0.0
            value = target + (value - target) * math.exp(-STEP_NS / numbers[3])
            out[step] = value
        elif kind == FLASHES:
            out[step] = math.exp(-turn / frequency / numbers[2])
    state[s, 0] = value


@njit(cache=True, nogil=True)
def _positions(begin_ns, path_at, path_ns, path_x, path_y):  # type: ignore[no-untyped-def]
    """Return where each light is at the end of each step, moved on in small jumps ``(s, BLOCK_STEPS)``, and if it moves."""
    count = len(path_at) - 1
    x_px = np.empty((count, BLOCK_STEPS))
    y_px = np.empty((count, BLOCK_STEPS))
    moves = np.zeros(count, np.uint8)
    for s in range(count):
        k = path_at[s] + np.searchsorted(path_ns[path_at[s] : path_at[s + 1]], begin_ns, side='right')
        last_x, last_y = math.nan, math.nan
        for step in range(BLOCK_STEPS):
            t = begin_ns + (step + 0.5) * STEP_NS
            while path_ns[k] <= t:
                k += 1
            share = (t - path_ns[k - 1]) / (path_ns[k] - path_ns[k - 1])
            x = path_x[k - 1] + share * (path_x[k] - path_x[k - 1])
            y = path_y[k - 1] + share * (path_y[k] - path_y[k - 1])
            if step == 0 or abs(x - last_x) + abs(y - last_y) > _MOVED_PX:
                moves[s] |= step > 0
                last_x, last_y = x, y
            x_px[s, step] = last_x
            y_px[s, step] = last_y
    return x_px, y_px, moves


@njit(cache=True, nogil=True, inline='always')
def _gaussian(state):  # type: ignore[no-untyped-def]
    """Return a number of mean 0 and variance 1: four 16-bit parts of a xorshift word, added up."""
    word = state[0]
    word ^= word << np.uint64(13)
    word ^= word >> np.uint64(7)
    word ^= word << np.uint64(17)
    state[0] = word
    low = np.uint64(0xFFFF)
    total = (word & low) + (word >> np.uint64(16) & low) + (word >> np.uint64(32) & low) + (word >> np.uint64(48))
    return (float(total) - 131070.0) * 2.6429e-05


@njit(cache=True, nogil=True, inline='always')
def _shape(dx, dy, profile, reach, half_x, half_y):  # type: ignore[no-untyped-def]
    """Return a light's share of its middle's irradiance at an offset (px)."""
    if half_x > 0.0:  # a rectangle, its borders one pixel soft
        across = min(max(half_x + 0.5 - abs(dx), 0.0), 1.0)
        return across * min(max(half_y + 0.5 - abs(dy), 0.0), 1.0)
    at = (dx * dx + dy * dy) / (reach * reach) * PROFILE_STEPS
    if at >= PROFILE_STEPS:
        return 0.0
    k = int(at)
    return profile[k] + (at - k) * (profile[k + 1] - profile[k])


@njit(cache=True, nogil=True)
def _covered(x_px, y_px, reach_px, half_px, slot, awake_list):  # type: ignore[no-untyped-def]
    """Return the pixels of a block, and as linked lists the lights each one sees.

    Returns:
        Their indices ``row · width + column``; head of each one's list; next entry and light of each entry.
    """
    height, width = slot.shape
    pixels = [np.int64(0)]  # numba takes a list's type from what is in it
    pixels.clear()
    heads = [np.int64(0)]
    heads.clear()
    following = [np.int64(0)]
    following.clear()
    of = [np.int64(0)]
    of.clear()
    for s in range(len(x_px)):
        reach_x = half_px[s, 0] + 1.0 if half_px[s, 0] > 0.0 else reach_px[s]
        reach_y = half_px[s, 1] + 1.0 if half_px[s, 0] > 0.0 else reach_px[s]
        left = max(int(math.ceil(x_px[s].min() - reach_x)), 0)
        right = min(int(math.floor(x_px[s].max() + reach_x)), width - 1)
        top = max(int(math.ceil(y_px[s].min() - reach_y)), 0)
        bottom = min(int(math.floor(y_px[s].max() + reach_y)), height - 1)
        x0, y0 = x_px[s, 0], y_px[s, 0]
        dx, dy = x_px[s, -1] - x0, y_px[s, -1] - y0
        length = max(dx * dx + dy * dy, 1e-12)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if half_px[s, 0] == 0.0:
                    along = min(max(((column - x0) * dx + (row - y0) * dy) / length, 0.0), 1.0)
                    off_x, off_y = column - x0 - along * dx, row - y0 - along * dy
                    # Half a pixel for a bounce within the block, which bends the way.
                    if off_x * off_x + off_y * off_y > (reach_px[s] + 0.5) ** 2:
                        continue
                at = slot[row, column]
                if at < 0:
                    at = len(pixels)
                    slot[row, column] = at
                    pixels.append(row * width + column)
                    heads.append(np.int64(-1))
                following.append(heads[at])
                of.append(np.int64(s))
                heads[at] = np.int64(len(of) - 1)
    for pixel in awake_list:
        row, column = pixel // width, pixel % width
        if slot[row, column] < 0:
            slot[row, column] = len(pixels)
            pixels.append(pixel)
            heads.append(np.int64(-1))
    for pixel in pixels:
        slot[pixel // width, pixel % width] = -1
    return pixels, heads, following, of


@njit(cache=True, nogil=True)
def _pixels(  # type: ignore[no-untyped-def]
    begin_ns,
    amplitude,
    strides,
    x_px,
    y_px,
    moves,
    profile,
    reach_px,
    half_px,
    threshold_on,
    threshold_off,
    refractory_ns,
    state_y1,
    state_y2,
    state_reference,
    state_free,
    state_scale,
    awake,
    awake_list,
    slot,
    physics,
    scans_ns,
    phase_ns,
    random,
):
    """Run all pixels of a block; return their events, how many they are, and the pixels that stay awake."""
    width = slot.shape[1]
    brightness, tau1, tau2, photon_noise, threshold_noise, leak = physics
    pixels, heads, following, of = _covered(x_px, y_px, reach_px, half_px, slot, awake_list)
    capacity = 1024
    t_ns = np.empty(capacity, np.int64)
    event_x = np.empty(capacity, np.uint16)
    event_y = np.empty(capacity, np.uint16)
    polarity = np.empty(capacity, np.int8)
    count = 0
    still_awake = np.empty(len(pixels), np.int64)
    kept = 0
    mine = np.empty(_MOST_LIGHTS, np.int64)
    share = np.empty(_MOST_LIGHTS)
    for at in range(len(pixels)):
        row, column = pixels[at] // width, pixels[at] % width
        on, off = threshold_on[row, column], threshold_off[row, column]
        refractory = refractory_ns[row, column]
        lights = 0
        moving = False
        stride = _LONGEST_STRIDE
        entry = heads[at]
        while entry >= 0 and lights < _MOST_LIGHTS:
            s = of[entry]
            mine[lights] = s
            share[lights] = _shape(column - x_px[s, 0], row - y_px[s, 0], profile[s], reach_px[s], half_px[s, 0], half_px[s, 1])
            moving |= moves[s] > 0
            stride = min(stride, strides[s])
            lights += 1
            entry = following[entry]
        if moving or (lights == 0 and abs(state_y1[row, column]) > 0.1):
            stride = 1
        while BLOCK_STEPS % stride:
            stride -= 1
        if awake[row, column]:
            y1, y2 = state_y1[row, column], state_y2[row, column]
            reference, free, scale = state_reference[row, column], state_free[row, column], state_scale[row, column]
        else:  # it rests at the background's level, its reference somewhere between the thresholds
            y1, y2, free, scale = 0.0, 0.0, 0.0, 1.0
            reference = 0.25 * _gaussian(random) * min(on, off)
        span = stride * STEP_NS
        a2 = span / (span + tau2)
        # White noise whose rms behind the second pole is photon_noise: variance · a2 / (2 − a2).
        noise = photon_noise * math.sqrt((2.0 - a2) / a2)
        reset = free > 0.0
        for step in range(stride - 1, BLOCK_STEPS, stride):
            light = 1.0
            for k in range(lights):
                s = mine[k]
                if moving and step and (x_px[s, step] != x_px[s, step - 1] or y_px[s, step] != y_px[s, step - 1]):
                    share[k] = _shape(
                        column - x_px[s, step], row - y_px[s, step], profile[s], reach_px[s], half_px[s, 0], half_px[s, 1]
                    )
                light += amplitude[s, step] * share[k]
            luminance = brightness * light
            y1 += span / (span + tau1 / luminance) * (math.log(light) - y1)
            before = y2
            y2 += a2 * (y1 + noise * _gaussian(random) / math.sqrt(luminance) - y2)
            end = float(begin_ns + (step + 1) * STEP_NS)
            if reset:
                if end >= free:
                    reference = before + (y2 - before) * min(max((free - end + span) / span, 0.0), 1.0)
                    reset = False
                    free = 0.0
                continue
            reference -= leak * span
            difference = y2 - reference
            if difference >= on * scale:
                crossed, sign = on * scale, 1
            elif difference <= -off * scale:
                crossed, sign = -off * scale, -1
            else:
                continue
            part = 1.0
            if y2 != before:
                part = min(max((reference + crossed - before) / (y2 - before), 0.0), 1.0)
            event = end - span + part * span
            if len(scans_ns):
                event = seen(event, phase_ns[row], scans_ns)
            if count == capacity:
                capacity *= 2
                t_ns, event_x, event_y, polarity = (
                    longer(t_ns, capacity),
                    longer(event_x, capacity),
                    longer(event_y, capacity),
                    longer(polarity, capacity),
                )
            t_ns[count] = int(event)
            event_x[count] = column
            event_y[count] = row
            polarity[count] = sign
            count += 1
            free = event + refractory
            reset = True
            scale = max(1.0 + threshold_noise * _gaussian(random), 0.2)
        awake[row, column] = lights > 0 or abs(y1) > _SETTLED
        if awake[row, column]:
            still_awake[kept] = pixels[at]
            kept += 1
            state_y1[row, column], state_y2[row, column] = y1, y2
            state_reference[row, column], state_free[row, column], state_scale[row, column] = reference, free, scale
    return t_ns, event_x, event_y, polarity, count, still_awake[:kept].copy()


@njit(cache=True, nogil=True)
def longer(array, size):  # type: ignore[no-untyped-def]
    """Return a copy of an array with room for ``size`` values."""
    copy = np.empty(size, array.dtype)
    copy[: len(array)] = array
    return copy
