"""Components against OpenCV's, and blobs of discs: centre, extent, time, both windows."""

import cv2
import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch, disc, gathered, hops, merged, noise
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.blobs import BlobFinder
from beacon_comm.core.components import AREA, BOTTOM, COUNT, LEFT, RIGHT, SEEDS, TOP, ComponentFinder
from beacon_comm.core.hop_events import CODE_BITS, ON, PixelGrid
from beacon_comm.core.index_image import IndexImages
from beacon_comm.core.parameters import Parameters

SIZE = (96, 70)


def packed(segment):
    return gathered(segment, SIZE)


def image_of(numbered):
    """Return the pixels of an image by pixel number."""
    return numbered.reshape(-1, PixelGrid(*SIZE).stride)[: SIZE[1], : SIZE[0]]


def blobs_of(events, parameters=None, size=SIZE):
    """Return the blobs at the hop after each segment, and the last finder."""
    parameters = parameters or Parameters()
    images, finder = IndexImages(parameters, size), BlobFinder(parameters, size)
    found = []
    for segment in hops(events):
        images.push(gathered(segment, size))
        found.append((segment.t_end_ns, finder.find(images, segment.t_end_ns)))
    return found, finder


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32), st.sampled_from([200, 1500, 6000]), st.integers(1, 7), st.sampled_from([0.5, 1.0])
)
def test_components_are_those_of_opencv(seed, events, closing_px, grow):
    """Low pixels, closed, labelled, by OpenCV; the events crowd at the corners so that borders matter."""
    parameters = Parameters(closing_px=closing_px, index_threshold=0.5, index_grow_share=grow, index_offset=4.0)
    rng = np.random.default_rng(seed)
    x = np.abs(np.rint(rng.normal(0, 25, events))).astype(int) % SIZE[0]
    y = (SIZE[1] - 1 - np.abs(np.rint(rng.normal(0, 25, events))).astype(int)) % SIZE[1]
    images = IndexImages(parameters, SIZE)
    finder = ComponentFinder(parameters, images.grid)
    images.push(packed(noise(*SIZE, 50_000, 0.005, seed=seed % 1000)))
    finder.find(images.windows[0], 0.5)  # leaves nothing behind
    images.push(packed(batch(x, y, rng.choice([-1, 1], events), np.full(events, T0_NS))))
    window = images.windows[0]
    components = finder.find(window, images.threshold)

    index = images.index(window)
    low = (index >= 0.5 * grow).astype(np.uint8)
    square = np.ones((closing_px, closing_px), np.uint8)
    closed = cv2.morphologyEx(low, cv2.MORPH_CLOSE, square)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    label = image_of(components.label)
    if closing_px % 2:  # OpenCV moves the result of an even square
        np.testing.assert_array_equal(label > 0, closed > 0)
        assert len(components) == count - 1
        for c in range(len(components)):
            other = labels[label == c + 1]
            assert len(set(other.tolist())) == 1
            left, top, width, height, area = stats[other[0]]
            s = components.sums[c]
            assert (s[LEFT], s[TOP], s[RIGHT], s[BOTTOM]) == (left, top, left + width - 1, top + height - 1)
            assert s[AREA] == area == np.diff(components.run[components.first[c] : components.first[c + 1]]).sum()
    for c in range(len(components)):
        mine = label == c + 1
        assert components.index[c] == pytest.approx(index[mine].mean())
        assert components.sums[c, SEEDS] == (index[mine] >= 0.5).sum()
        assert components.sums[c, COUNT] == images.counts(window)[:, mine].sum()
    assert ((label > 0) | (low == 0)).all()  # closing loses nothing


def test_a_disc_is_one_blob_with_its_centre_and_radius():
    found, _ = blobs_of(disc(40.3, 30.6, duration_s=0.5))
    late = [blobs for _, blobs in found[3:-1]]
    assert all(len(blobs) == 1 for blobs in late)
    assert np.mean([b.x_px for (b,) in late]) == pytest.approx(40.3, abs=0.05)
    assert np.mean([b.y_px for (b,) in late]) == pytest.approx(30.6, abs=0.05)
    assert np.mean([b.extent_px for (b,) in late]) == pytest.approx(4.0, abs=0.25)
    assert all(b.fresh and 40 < b.area_px < 75 for (b,) in late)


@pytest.mark.parametrize('speed', [50.0, 500.0])
@pytest.mark.parametrize('rate_per_s', [128 * 504.0, 97 * 3125.0])
def test_the_centre_of_a_moving_disc_does_not_lag(speed, rate_per_s):
    """At the observation's own time, and that lies in the newest hop."""
    size = (600, 70)
    events = disc(30.0, 30.0, vx=speed, duration_s=1.0, rate_per_s=rate_per_s)
    found, _ = blobs_of(events, size=size)
    late = [(t, blobs[0]) for t, blobs in found[4:-1]]
    assert all(t - HOP_NS <= blob.t_ns < t for t, blob in late)
    error = [blob.x_px - (30.0 + speed * (blob.t_ns - T0_NS) / 1e9) for _, blob in late]
    assert abs(np.mean(error)) < 0.1
    assert np.std(error) < 0.3
    assert max(blob.extent_px for _, blob in late) < 5.5


def test_a_slow_beacon_is_seen_by_the_long_window():
    parameters = Parameters(bit_rates=(20.0, 3125.0))
    slow = disc(40.0, 30.0, rate_per_s=49 * 40.0, bit_rate_bps=20.0, duration_s=2.0)
    found, _ = blobs_of(slow, parameters)
    late = [blobs for _, blobs in found[120:-1]]
    assert all(len(blobs) == 1 and blobs[0].window == 1 for blobs in late)


def test_overlapping_windows_give_one_blob_the_short_ones():
    parameters = Parameters(bit_rates=(20.0, 3125.0))
    found, _ = blobs_of(disc(20.0, 30.0, vx=25.0, duration_s=2.0), parameters)
    late = [blobs for _, blobs in found[10:-1]]
    assert all(len(blobs) == 1 and blobs[0].window == 0 for blobs in late)


def test_a_beacon_the_short_window_sees_in_part_is_one_blob():
    """Some of its pixels above the threshold in the short window, all of them in the long one."""
    parameters = Parameters(bit_rates=(50.0, 3125.0))
    found, _ = blobs_of(
        disc(40.0, 30.0, rate_per_s=49 * 220.0, bit_rate_bps=50.0, duration_s=2.0), parameters
    )
    late = [blobs for _, blobs in found[50:-1]]
    assert {blob.window for blobs in late for blob in blobs} == {0, 1}
    assert np.mean([len(blobs) == 1 for blobs in late]) > 0.97
    assert min(blob.extent_px for blobs in late for blob in blobs) > 2.5


def test_two_discs_are_two_blobs():
    found, _ = blobs_of(merged(disc(30.0, 30.0, duration_s=0.3), disc(42.0, 30.0, duration_s=0.3, seed=5)))
    for _, blobs in found[3:-1]:
        assert sorted(round(blob.x_px) for blob in blobs) == [30, 42]


def test_area_limits():
    small = batch([10, 10] * 50, [10, 11] * 50, [1, -1, -1, 1] * 25, T0_NS + np.arange(100))
    assert not blobs_of(small)[0][0][1]
    assert len(blobs_of(small, Parameters(min_area_px=2))[0][0][1]) == 1
    found, finder = blobs_of(disc(40.0, 30.0, radius_px=20.0, rate_per_s=2e6, duration_s=0.05))
    assert found[2][1]
    found, finder = blobs_of(
        disc(40.0, 30.0, radius_px=20.0, rate_per_s=2e6, duration_s=0.05), Parameters(max_area_px=400)
    )
    assert not any(blobs for _, blobs in found)


def test_owner_names_the_blob_of_each_pixel_and_is_cleared():
    parameters = Parameters()
    images, finder = IndexImages(parameters, SIZE), BlobFinder(parameters, SIZE)
    segments = list(hops(merged(disc(30.0, 30.0), disc(60.0, 30.0, seed=5))))
    images.push(packed(segments[0]))
    images.push(packed(segments[1]))
    blobs = finder.find(images, segments[1].t_end_ns)
    owner = image_of(finder.owner)
    for number, blob in enumerate(blobs, 1):
        assert owner[round(blob.y_px), round(blob.x_px)] == number
        assert (owner == number).sum() == blob.area_px
    for _ in range(images.windows[-1].hops):
        images.push(packed(batch([], [], [], [])))
    assert finder.find(images, segments[1].t_end_ns) == []
    assert not finder.owner.any()


def test_background_in_front_of_a_held_led_is_no_observation():
    """A few events of something else do not move a blob that is silent."""
    few = batch([46] * 8, [30] * 8, [1] * 8, T0_NS + 55_000_000 + np.arange(8))
    held = merged(disc(40.0, 30.0, duration_s=0.04), few)
    found, _ = blobs_of(held)
    (blob,) = next(blobs for t, blobs in found if t > T0_NS + 55_000_000)
    assert blob.fresh_count == 8 and not blob.fresh
    assert blob.x_px == pytest.approx(40.0, abs=0.3)


def test_noise_makes_no_blob():
    found, _ = blobs_of(noise(*SIZE, 60_000, 1.0))  # 9 events per pixel and second
    assert not any(blobs for _, blobs in found)


def test_the_router_lists_the_events_and_counts_them_by_bit_planes():
    size = (600, 300)
    segment = next(iter(hops(noise(*size, 1_000_000, 0.005))))
    events, grid = gathered(segment, size), PixelGrid(*size)
    y, x = np.divmod(events.code >> CODE_BITS, grid.stride)
    np.testing.assert_array_equal(x, segment.x)
    np.testing.assert_array_equal(y, segment.y)
    np.testing.assert_array_equal((events.code & ON) > 0, segment.polarity > 0)
    np.testing.assert_array_equal(events.t_start_ns + events.offset_ns.astype(np.int64), segment.t_ns)
    counts = np.zeros((2, *size[::-1]), np.int64)
    np.add.at(counts, ((segment.polarity > 0).astype(int), segment.y, segment.x), 1)
    rows = np.flatnonzero(counts.any(axis=(0, 2)))
    np.testing.assert_array_equal(events.rows, rows)
    for k, y in enumerate(rows):
        planes = events.planes[events.first[k] : events.first[k + 1]].reshape(-1, 2, grid.words)
        bits = np.unpackbits(planes.astype('<u8').view(np.uint8), axis=-1, bitorder='little')[..., : size[0]]
        np.testing.assert_array_equal(np.tensordot(1 << np.arange(len(bits)), bits, (0, 0)), counts[:, y])
        assert planes[-1].any()
