"""A textured background that moves with the camera, and the events of all the sensor's pixels it runs over.

The texture is two layers of patches with sharp borders (the sign of blurred noise), seen through the point spread, larger
than the sensor by the camera's motion.  The image is taken so often that it moves at most ``STEP_PX`` from one to the
next, as ESIM does (Rebecq et al. 2018); between two images a pixel's log intensity is a straight line, and its crossings
of the thresholds are events at their own times.

    image k ──►  ln I bilinear at the shift  ──► low-pass (photoreceptor at the background's brightness)
                 y − reference ≥ θ_on: ON, reference += θ_on, again and again; ≤ −θ_off: OFF; not sooner than refractory_us

Simpler than under the lights: no second pole, no noise in the pixel (both are drawn besides, evenly), and the reference
moves by the threshold.  The texture also runs on under a beacon's spot, where in truth the LED outshines it: its events
are added there, which is a little harder than real.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from beacon_comm.core.errors import ParameterError
from beacon_comm.simulation.description import SceneDescription, Texture
from beacon_comm.simulation.pixels import Mismatch, RawEvents, longer
from beacon_comm.simulation.trajectory import Floats, Trajectory

STEP_PX = 0.4
LAYERS = (0.8, 0.6)  # shares of the contrast: together its rms
_SLOWEST_STEP_NS = 1_000_000


class MovingTexture:
    """The texture of a scene; keeps its pixels' state from piece to piece."""

    def __init__(
        self,
        texture: Texture,
        path: Trajectory,
        description: SceneDescription,
        mismatch: Mismatch,
        random: np.random.Generator,
    ) -> None:
        sensor = description.sensor
        self._path = path
        reach = np.array([[path.x_px.min(), path.x_px.max()], [path.y_px.min(), path.y_px.max()]])
        self._origin = np.ceil(reach[:, 1]) + 1.0
        extra = np.ceil(reach[:, 1] - reach[:, 0]).astype(int) + 4
        grain_px = texture.grain_px
        if texture.events_per_s is not None:
            grain_px = _grain_for(texture.events_per_s, texture.contrast, path, description)
        shape = (sensor.height + int(extra[1]), sensor.width + int(extra[0]))
        layers = [share * _patches(shape, grain_px, random) for share in LAYERS]
        self._field = texture.contrast * _blurred(layers[0] + layers[1], sensor.psf_px)
        self._mismatch = mismatch
        self._tau_ns = sensor.photoreceptor_us * 1e3 / description.background.brightness
        self._level = self._image(0)
        self._reference = self._level + 0.5 * random.uniform(-sensor.threshold_off, sensor.threshold_on, self._level.shape)
        self._last_ns = np.full(self._level.shape, -1e15)
        self._now_ns = 0

    def piece(self, end_ns: int) -> RawEvents:
        """Return the events from the last piece's end to ``end_ns`` (ns), not in order."""
        parts = []
        while self._now_ns < end_ns:
            step_ns = min(self._step_ns(), end_ns - self._now_ns)
            part = _step(
                self._image(self._now_ns + step_ns),
                float(self._now_ns),
                float(step_ns),
                self._tau_ns,
                self._mismatch.threshold_on,
                self._mismatch.threshold_off,
                self._mismatch.refractory_ns,
                self._level,
                self._reference,
                self._last_ns,
            )
            parts.append(part)
            self._now_ns += step_ns
        t_ns, x, y, polarity = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return t_ns, x, y, polarity

    def _step_ns(self) -> int:
        times = self._now_ns + np.array([0, 100_000])
        x, y = self._path.at(times)
        speed = max(abs(x[1] - x[0]), abs(y[1] - y[0])) / 100_000.0
        return int(min(STEP_PX / max(speed, 1e-12), _SLOWEST_STEP_NS)) // 1000 * 1000 + 1000

    def _image(self, t_ns: int) -> Floats:
        """Return the log intensity of every pixel at a time (ns), ``(height, width)``."""
        dx, dy = self._path.at(t_ns)
        x, y = self._origin[0] - float(dx), self._origin[1] - float(dy)
        height, width = self._mismatch.threshold_on.shape
        column, row = math.floor(x), math.floor(y)
        return _bilinear(self._field, row, column, y - row, x - column, height, width)


def _patches(shape: tuple[int, int], grain_px: float, random: np.random.Generator) -> Floats:
    """Return patches of +1 and -1 of a size."""
    return np.sign(_blurred(random.normal(size=shape), grain_px))


def _blurred(field: Floats, sigma_px: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(field, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT), np.float64)


def _grain_for(events_per_s: float, contrast: float, path: Trajectory, description: SceneDescription) -> float:
    """Return the size of patches whose borders, as the image moves, make so many events a second in the mean.

    Along a straight way the sign of noise blurred by σ changes 1 / (π √2 σ) times a pixel (Rice 1944); a border of height
    h gives about h / θ − 1/2 events.

    Raises:
        ParameterError: nothing moves, or the patches would be smaller than a pixel sees.
    """
    sensor = description.sensor
    t_ns = np.linspace(0, description.duration_s * 1e9, 2000)
    x, y = path.at(t_ns)
    speed = float(np.mean(np.hypot(np.diff(x), np.diff(y)) / np.diff(t_ns))) * 1e9
    threshold = 0.5 * (sensor.threshold_on + sensor.threshold_off)
    steps = sum(max(2.0 * share * contrast / threshold - 0.5, 0.0) for share in LAYERS)
    per_s = speed / (math.pi * math.sqrt(2.0)) * steps * sensor.width * sensor.height
    grain_px = per_s / max(events_per_s, 1e-9)
    if grain_px < sensor.psf_px:
        raise ParameterError(
            f'background.texture.events_per_s = {events_per_s:g}: more contrast or more motion (shake) is needed;'
            f' with these it is at most {per_s / sensor.psf_px:.2g}'
        )
    return min(grain_px, float(min(sensor.width, sensor.height)))


@njit(cache=True, nogil=True)
def _bilinear(field, row, column, down, across, height, width):  # type: ignore[no-untyped-def]
    image = np.empty((height, width))
    w00, w01 = (1.0 - down) * (1.0 - across), (1.0 - down) * across
    w10, w11 = down * (1.0 - across), down * across
    for y in range(height):
        above, below = field[row + y], field[row + y + 1]
        for x in range(width):
            k = column + x
            image[y, x] = w00 * above[k] + w01 * above[k + 1] + w10 * below[k] + w11 * below[k + 1]
    return image


@njit(cache=True, nogil=True)
def _step(image, begin_ns, span_ns, tau_ns, threshold_on, threshold_off, refractory_ns, level, reference, last_ns):  # type: ignore[no-untyped-def]
    """Move all pixels on by one image; return the events."""
    height, width = image.shape
    follow = 1.0 - math.exp(-span_ns / max(tau_ns, 1.0))
    capacity = 4096
    t_ns = np.empty(capacity, np.int64)
    event_x = np.empty(capacity, np.uint16)
    event_y = np.empty(capacity, np.uint16)
    polarity = np.empty(capacity, np.int8)
    count = 0
    for y in range(height):
        if count + 64 * width > capacity:
            capacity = 2 * capacity + 64 * width
            t_ns, event_x, event_y, polarity = (
                longer(t_ns, capacity),
                longer(event_x, capacity),
                longer(event_y, capacity),
                longer(polarity, capacity),
            )
        for x in range(width):
            before = level[y, x]
            now = before + follow * (image[y, x] - before)
            level[y, x] = now
            difference = now - reference[y, x]
            on, off = threshold_on[y, x], threshold_off[y, x]
            if -off < difference < on:
                continue
            for _ in range(64):
                if difference >= on:
                    crossed, sign = reference[y, x] + on, 1
                elif difference <= -off:
                    crossed, sign = reference[y, x] - off, -1
                else:
                    break
                event = begin_ns
                if now != before:
                    event += span_ns * min(max((crossed - before) / (now - before), 0.0), 1.0)
                if event < last_ns[y, x] + refractory_ns[y, x]:
                    event = last_ns[y, x] + refractory_ns[y, x]  # held in reset: it comes when the reset ends, from there on
                    if event >= begin_ns + span_ns:
                        break
                    crossed = before + (now - before) * (event - begin_ns) / span_ns
                t_ns[count] = int(event)
                event_x[count] = x
                event_y[count] = y
                polarity[count] = sign
                count += 1
                reference[y, x] = crossed
                last_ns[y, x] = event
                difference = now - crossed
    return t_ns[:count].copy(), event_x[:count].copy(), event_y[:count].copy(), polarity[:count].copy()
