"""The disc: path, borders, pixels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beacon_comm.core.errors import ParameterError
from beacon_comm.recordings.disc import Disc


def test_parse_with_defaults() -> None:
    assert Disc.parse('100,50', 640, 480) == Disc(100, 50, 4, 0, 0, 640, 480)
    assert Disc.parse('100,50,6', 640, 480) == Disc(100, 50, 6, 0, 0, 640, 480)
    disc = Disc.parse('100,50.5,3,-20,10', 640, 480)
    assert disc == Disc(100, 50.5, 3, -20, 10, 640, 480)
    assert Disc.parse(disc.text(), 640, 480) == disc


@pytest.mark.parametrize('text', ['', '1', 'a,b', '1,2,3,4', '1,2,3,4,5,6', '100,100,0', '100,100,-1', 'nan,100'])
def test_what_is_no_disc_is_refused(text: str) -> None:
    with pytest.raises(ParameterError, match='disc'):
        Disc.parse(text, 640, 480)


def test_a_disc_beyond_the_sensor_is_refused() -> None:
    with pytest.raises(ParameterError, match=r'x must lie in \[4, 635\] px of the 640×480 sensor'):
        Disc.parse('638,100', 640, 480)
    with pytest.raises(ParameterError, match='y must lie in'):
        Disc.parse('100,3.5', 640, 480)


def test_path_is_straight_then_bounces() -> None:
    disc = Disc(600, 100, 4, 50, 0, 640, 480)
    x, y = disc.centre([0.0, 0.5, 0.7, 0.8, 1.0])
    np.testing.assert_allclose(x, [600, 625, 635, 630, 620])  # the rim touches the border (x = 639) at x = 635
    np.testing.assert_allclose(y, 100)


@given(
    x=st.floats(4, 85),
    y=st.floats(4, 55),
    vx=st.floats(-500, 500),
    vy=st.floats(-500, 500),
    t_s=st.floats(0, 1000),
)
def test_path_stays_on_the_sensor_and_is_continuous(x: float, y: float, vx: float, vy: float, t_s: float) -> None:
    disc = Disc(x, y, 4, vx, vy, 90, 60)
    (x0, x1), (y0, y1) = disc.centre([t_s, t_s + 1e-3])
    assert 4 <= x0 <= 85 and 4 <= y0 <= 55
    assert abs(x1 - x0) <= abs(vx) * 1e-3 + 1e-6 and abs(y1 - y0) <= abs(vy) * 1e-3 + 1e-6


def test_a_disc_as_large_as_the_sensor_stays() -> None:
    x, y = Disc(4, 4, 4, 100, 100, 9, 9).centre(np.linspace(0, 1, 11))
    assert set(x) == {4.0} and set(y) == {4.0}


def test_pixels_fill_the_disc_evenly_around_the_centre() -> None:
    t_ns = np.zeros(60_000, np.int64)
    x, y = Disc(100.3, 50.6, 4, 0, 0, 640, 480).pixels(t_ns, 7)
    assert x.dtype == y.dtype == np.uint16
    assert np.hypot(x - 100.3, y - 50.6).max() <= 4 + np.sqrt(0.5)
    assert abs(x.mean() - 100.3) < 0.05 and abs(y.mean() - 50.6) < 0.05
    _, counts = np.unique(x.astype(np.int64) * 1000 + y, return_counts=True)
    even = len(t_ns) / (np.pi * 16)
    assert np.sum(counts > 0.9 * even) >= 32  # the inner pixels, each with its whole share of some 50
    assert counts.max() < 1.15 * even


def test_pixels_follow_the_path_and_are_deterministic() -> None:
    disc = Disc(30, 40, 4, 50, -20, 640, 480)
    t_ns = np.linspace(0, 10e9, 50_000).astype(np.int64)
    x, y = disc.pixels(t_ns, [0, 1])
    true_x, true_y = disc.centre(t_ns * 1e-9)
    assert np.hypot(x - true_x, y - true_y).max() <= 4 + np.sqrt(0.5)
    for part in np.split(np.arange(50_000), 10):
        assert abs(np.mean(x[part] - true_x[part])) < 0.1 and abs(np.mean(y[part] - true_y[part])) < 0.1
    again = disc.pixels(t_ns, [0, 1])
    assert np.array_equal(x, again[0]) and np.array_equal(y, again[1])
    assert not np.array_equal(x, disc.pixels(t_ns, [0, 2])[0])


def test_a_disc_at_the_border_keeps_its_pixels_on_the_sensor() -> None:
    x, y = Disc(635, 4, 4, 0, 0, 640, 480).pixels(np.zeros(20_000, np.int64), 1)
    assert x.max() == 639 and y.min() == 0 and y.max() <= 8
