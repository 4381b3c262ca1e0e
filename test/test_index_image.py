"""The index images against a count from scratch, and their bounds."""

import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch, gathered, hops, noise
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.hop_events import HOP_PLANES
from beacon_comm.core.index_image import IndexImages, pixel_counts, whole_hops, window_hops
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Router

SIZE = (40, 30)


def hop_events(segment):
    return gathered(segment, SIZE)


def expected_index(events, t_from, t_to, offset=10.0, size=SIZE):
    """Return n / (B + |Σσ|) of the events in [t_from, t_to), pixel by pixel."""
    inside = (events.t_ns >= t_from) & (events.t_ns < t_to)
    n, balance = np.zeros(size[::-1]), np.zeros(size[::-1])
    np.add.at(n, (events.y[inside], events.x[inside]), 1)
    np.add.at(balance, (events.y[inside], events.x[inside]), events.polarity[inside])
    return n / (offset + np.abs(balance))


# Above 1 a subtraction can list a pixel.
@pytest.mark.parametrize(
    ('threshold', 'offset', 'size'),
    [
        (0.6, 10.0, SIZE), (2.0, 1.0, SIZE), (0.6, 10.0, (130, 12)), (0.6, 10.0, (1, 1)), (0.6, 1.0, (63, 2)),
        (0.6, 1.0, (64, 1)), (0.6, 1.0, (65, 3)), (0.3, 10.0, (4096, 2)),
    ],
)  # fmt: skip
def test_sliding_windows_equal_counting_from_scratch(threshold, offset, size):
    parameters = Parameters(bit_rates=(200.0, 3125.0), index_threshold=threshold, index_offset=offset)
    images = IndexImages(parameters, size)
    assert [window.hops for window in images.windows] == [2, 11]
    events = noise(*size, rate_per_s=min(200_000, 5_000 * size[0] * size[1]), duration_s=0.3)  # no count is full
    for k, segment in enumerate(hops(events)):
        images.push(gathered(segment, size))
        for window in images.windows:
            start = segment.t_end_ns - window.hops * HOP_NS
            np.testing.assert_array_equal(
                images.index(window), expected_index(events, start, segment.t_end_ns, offset, size)
            )
            assert window.events == images.counts(window).sum()
            low = images.index(window) >= parameters.index_threshold / 2
            np.testing.assert_array_equal(images.low_pixels(window), low)
        taken_off = [images.take_off() for _ in range(k % 4)]  # nothing, a window, both
        assert taken_off == [True, True, False][: k % 4]


def test_windows_run_empty():
    images = IndexImages(Parameters(), SIZE)
    images.push(hop_events(noise(*SIZE, 10_000, 0.009)))
    assert not images.empty
    for _ in range(images.windows[-1].hops):
        images.push(hop_events(batch([], [], [], [])))
    assert images.empty
    assert not any(window.planes.any() or window.low.any() for window in images.windows)


def test_a_count_ends_and_runs_empty_again():
    """What is not counted is not taken off either, in whichever window it was."""
    images = IndexImages(Parameters(), SIZE)
    lone = hop_events(batch([7], [3], [-1], [T0_NS]))
    full = hop_events(batch([7] * 300, [3] * 300, [1] * 300, np.full(300, T0_NS)))
    images.push(full)
    images.push(full)
    for window in images.windows:
        assert images.counts(window)[:, 3, 7].tolist() == [0, 2 * 255]
    images.push(lone)
    assert images.counts(images.windows[0])[:, 3, 7].tolist() == [1, 255]  # those of the first hop are gone
    assert images.counts(images.windows[1])[:, 3, 7].tolist() == [1, 2 * 255]
    for _ in range(images.windows[-1].hops):
        images.push(hop_events(batch([], [], [], [])))
    assert not any(window.planes.any() for window in images.windows)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.integers(0, 300)), max_size=6), max_size=9))
def test_counts_of_any_size_slide_through_the_windows(hops_of):
    """Whatever carries and borrows there are; three neighbours at the border of a word."""
    images = IndexImages(Parameters(), (130, 12))
    expected = []
    for runs in hops_of:
        x = np.concatenate([np.full(n, 62 + place) for place, _, n in runs] + [[]]).astype(int)
        on = np.concatenate([np.full(n, up) for _, up, n in runs] + [[]]).astype(int)
        counts = np.zeros((2, 12, 130), int)
        np.add.at(counts, (on, 5, x), 1)
        expected.append(np.minimum(counts, 255))
        images.push(gathered(batch(x, np.full(len(x), 5), 2 * on - 1, T0_NS + np.arange(len(x))), (130, 12)))
        for window in images.windows:
            off, on = sum(expected[-window.hops :])
            np.testing.assert_array_equal(images.counts(window), [off, on])
            n, index = off + on, (off + on) / (10.0 + np.abs(on - off))
            np.testing.assert_array_equal(images.low_pixels(window), (n > 0) & (index >= 0.3))
            for y, x_px in ((5, 62), (5, 63), (5, 64), (0, 0)):
                assert pixel_counts(window.planes, window.used, y, x_px) == (off[y, x_px], on[y, x_px])


def test_a_full_window_of_many_hops_runs_empty_again():
    slow = Parameters(bit_rates=(20.0,), hop_s=0.001)
    assert window_hops(slow) == (20, 1100)
    images, router, many = IndexImages(slow, SIZE), Router(slow, SIZE), 300
    full = batch([7] * 2 * many, [3] * 2 * many, [1, -1] * many, np.full(2 * many, T0_NS))
    for k in range(2 * 1100):
        router.aim((), T0_NS)
        router.route(full if k < 1100 else full.slice(0, 0, T0_NS))
        images.push(router.close())
        if k == 1099:
            assert images.counts(images.windows[1])[:, 3, 7].tolist() == 2 * [1100 * 255]
            assert images.low_pixels(images.windows[1]).sum() == 1
    assert not any(window.planes.any() or window.low.any() for window in images.windows)


def test_a_long_window_no_longer_than_the_short_one_is_not_kept():
    assert len(IndexImages(Parameters(bit_rates=(3125.0,)), SIZE).windows) == 1
    assert [w.hops for w in IndexImages(Parameters(bit_rates=(20.0,)), SIZE).windows] == [2, 110]


@pytest.mark.parametrize(('window_s', 'expected'), [(0.02, 2), (0.0201, 3), (0.001, 1), (1.1, 110)])
def test_windows_are_whole_hops(window_s, expected):
    assert whole_hops(window_s, 0.01) == expected


def test_noise_pixel_scores_low_and_a_balanced_one_high():
    images = IndexImages(Parameters(), SIZE)
    polarity = [1, -1] + [1, -1] * 20 + [1] * 40
    x = [0, 0] + [1] * 40 + [2] * 40
    images.push(hop_events(batch(x, [5] * 82, polarity, T0_NS + np.arange(82))))
    index = images.index(images.windows[0])
    assert index[5, :4].tolist() == [0.2, 4.0, 0.8, 0.0]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 400), min_size=1, max_size=30), st.integers(1000, 50_000))
def test_the_ring_is_bounded_and_overflow_counted(sizes, max_bytes):
    images = IndexImages(Parameters(bit_rates=(100.0,), window_max_bytes=max_bytes), SIZE)
    pushed = 0
    for k, size in enumerate(sizes):
        images.push(hop_events(noise(*SIZE, 1.0, 1.0, seed=k)) if size == 0 else _many(size, k))
        pushed += len(images.newest)
        kept = images.hop_events(images.windows[-1])
        assert sum(len(events) for events in kept) == images.windows[-1].events
        assert sum(events.size_bytes for events in kept[:-1]) + images.newest.size_bytes <= max(
            max_bytes, images.newest.size_bytes
        )
        for window in images.windows:
            assert images.counts(window).sum() == window.events
        for _ in range(k % 3):
            images.take_off()
    if pushed * 8 + len(sizes) * images.grid.height * (16 + 8 * 2 * HOP_PLANES * images.grid.words) <= max_bytes:
        assert images.overflow_events == 0
    assert images.windows[-1].events + images.overflow_events <= pushed


def _many(size, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, SIZE[0], size), rng.integers(0, SIZE[1], size)
    return hop_events(batch(x, y, rng.choice([-1, 1], size), T0_NS + np.arange(size)))


@pytest.mark.parametrize('size', [(0, 10), (10, 0), (20_000, 10)])
def test_an_impossible_sensor_is_refused(size):
    with pytest.raises(ValueError, match='sensor_size'):
        IndexImages(Parameters(), size)
