"""beacon_evaluate --report: one page that needs nothing else; its signal is the receiver's own."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from beacon_comm.cli.evaluate import main
from beacon_comm.core.character import Character, Status
from beacon_comm.core.events import EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import HighPassFilter
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.figures import extremes, nines, rolling_share
from beacon_comm.evaluation.page import STYLE, Page, inline_svg, new_figure
from beacon_comm.evaluation.scoring import CharacterError, not_found
from beacon_comm.evaluation.views import Stretch, choose_stretch, image_span_ns, sent_within, trace_filter, view_image
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Beacon
from beacon_comm.recordings.truth import write_truth
from beacon_comm.simulation.led import simulate_text

FRAME = CharacterFrame()
TEXT = 'A beacon of one line. '
VOID = {'meta', 'br', 'link', 'img', 'path', 'use', 'rect', 'image', 'circle', 'line'}


class Outline(HTMLParser):
    """What a page is made of; fails on tags that are not closed in turn."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.text = ''
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.count[tag] = self.count.get(tag, 0) + 1
        for name, value in attributes:
            if name in ('src', 'href', 'xlink:href'):
                self.addresses.append(value)
            elif name == 'id':
                self.ids.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def beacon(name: str, text: str, bit_rate_bps: float, disc: Disc, seed: int) -> Beacon:
    t_ns, polarity = simulate_text(text, bit_rate_bps, lead_s=0.0, tail_s=0.0, seed=seed)
    return Beacon(name, 'simulated', t_ns, polarity, int(t_ns[-1]), disc, text=text, bit_rate_bps=bit_rate_bps)


@pytest.fixture(scope='module')
def scene(tmp_path_factory) -> Path:
    """Return a bag of two beacons with its truth."""
    moving = beacon('moving <1>', TEXT * 6, 3125.0, Disc(40.0, 60.0, 4.0, 50.0, 20.0, 200, 160), 1)
    still = beacon('still', TEXT * 3, 1500.0, Disc(140.0, 100.0, 4.0, 0.0, 0.0, 200, 160), 2)
    made = Scene((moving, still), 200, 160)
    folder = tmp_path_factory.mktemp('report') / 'scene'
    with BagWriter(folder) as writer:
        writer.add_topic('/event_camera/events', 'event_camera_msgs/msg/EventPacket')
        for recorded_ns, cdr in made.packets():
            writer.write('/event_camera/events', recorded_ns, cdr)
    write_truth(folder / 'truth.json', made)
    return folder


def check(page: str) -> Outline:
    outline = Outline(page)
    outside = [address for address in outline.addresses if not address.startswith(('#', 'data:'))]
    assert outside == []
    assert 'url(http' not in page and '@import' not in page and '<script' not in page
    assert len(outline.ids) == len(set(outline.ids))
    named = {address[1:] for address in outline.addresses if address.startswith('#')}
    named |= set(re.findall(r'url\(#([^)]+)\)', page))
    assert named <= set(outline.ids)
    return outline


def test_a_scene_with_both_receivers(scene, tmp_path, capsys) -> None:
    folder = tmp_path / 'made' / 'here'
    arguments = [str(scene), '--bit-rate', '1500,3125', '--receiver', 'sequence,threshold', '--report', str(folder)]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert 'wrote' in captured.err and 'threshold' in captured.out
    assert [path.name for path in folder.iterdir()] == ['index.html']
    outline = check((folder / 'index.html').read_text())
    # Rates, image, over time, a signal for each beacon, reliability.
    assert outline.count['figure'] == outline.count['svg'] == outline.count['figcaption'] == 6
    assert outline.count['image'] >= 1
    assert outline.count['details'] == 6  # a text for each beacon and receiver, parameters of both
    for said in ('moving <1>', '2 of 2', 'MOTA', 'IDF1', 'false confirmations', 'beacon_evaluate', TEXT.strip(), 'hop_s'):
        assert said in outline.text, said


def test_a_bag_without_a_truth_and_one_without_a_beacon(scene, tmp_path, capsys) -> None:
    quiet = tmp_path / 'quiet'
    with BagWriter(quiet) as writer:
        writer.add_topic('/event_camera/events', 'event_camera_msgs/msg/EventPacket')
        nothing = Beacon(
            'noise', 'mat', np.arange(1, 200) * 1_000_000, np.ones(199, np.int8), 200_000_000, Disc(30, 30, 20, 0, 0, 64, 64)
        )
        for recorded_ns, cdr in Scene((nothing,), 64, 64).packets():
            writer.write('/event_camera/events', recorded_ns, cdr)
    arguments = [str(scene), str(quiet), '--bit-rate', '1500,3125', '--truth', 'none', '--report', str(tmp_path / 'page')]
    assert main(arguments) == 0
    outline = check((tmp_path / 'page' / 'index.html').read_text())
    assert outline.count['figure'] == 4  # two images, two signals
    assert 'MOTA' not in outline.text and 'what was sent' not in outline.text
    assert 'in the middle of what was decoded'.capitalize() in outline.text


def test_a_folder_that_cannot_be_made_costs_no_evaluation(scene, tmp_path, capsys) -> None:
    (tmp_path / 'file').touch()
    assert main([str(scene), '--report', str(tmp_path / 'file')]) == 2
    assert capsys.readouterr().err.count('\n') == 1


def test_the_traced_filter_is_the_receivers() -> None:
    """Its edges are those of the filter over the whole signal, and its line crosses the levels there."""
    parameters = Parameters()
    t_ns, polarity = simulate_text(TEXT * 4, 1500.0, seed=3)
    whole = HighPassFilter(1500.0, parameters).push(t_ns, polarity)
    stretch = Stretch(300_000_000, 330_000_000, 1500.0, '')
    trace = trace_filter(t_ns, polarity, stretch, parameters)
    inside = (whole.t_ns >= stretch.begin_ns) & (whole.t_ns < stretch.end_ns)
    assert trace.edges_ns.tolist() == whole.t_ns[inside].tolist()
    assert trace.rising.tolist() == whole.rising[inside].tolist()
    assert len(trace.edges_ns) > 10
    assert trace.line_before == bool(whole.rising[np.flatnonzero(inside)[0] - 1])
    assert np.all(np.diff(trace.t_ns) >= 0)
    for edge_ns, rising in zip(trace.edges_ns, trace.rising, strict=True):
        at = np.flatnonzero(trace.t_ns == edge_ns)
        above = trace.filtered[at] > trace.high[at] if rising else trace.filtered[at] < trace.low[at]
        assert above.any()


def test_the_filter_decays_between_events() -> None:
    parameters = Parameters()
    t_ns = np.array([0, 100_000_000], np.int64)
    trace = trace_filter(t_ns, np.ones(2, np.int8), Stretch(0, 100_000_000, 100.0, ''), parameters)
    expected = np.exp(-parameters.cutoff_per_bit * 100.0 * trace.t_ns * 1e-9)
    assert len(trace.t_ns) > 50
    np.testing.assert_allclose(trace.filtered, expected, rtol=1e-9)


def test_the_image_shows_what_is_there() -> None:
    parameters = Parameters()
    t_ns, polarity = simulate_text(TEXT * 3, 1500.0, lead_s=0.0, seed=4)
    x, y = Disc(60.0, 40.0, 4.0, 0.0, 0.0, 128, 96).pixels(t_ns, 1)
    begin_ns, end_ns = image_span_ns(250_123_456, parameters)
    assert (begin_ns % 10_000_000, end_ns) == (0, 250_000_000)
    own = (t_ns >= begin_ns) & (t_ns < end_ns)
    batch = EventBatch(x[own], y[own], polarity[own], t_ns[own], end_ns)
    index, blobs, window_s = view_image(batch, (128, 96), begin_ns, 0, parameters)
    assert (index.shape, window_s) == ((96, 128), 0.02)
    (blob,) = blobs
    assert np.hypot(blob.x_px - 60.0, blob.y_px - 40.0) < 1.0
    short = t_ns[own] >= end_ns - 20_000_000
    here = short & (x[own] == 60) & (y[own] == 40)
    count, total = here.sum(), polarity[own][here].sum()
    assert index[40, 60] == pytest.approx(count / (parameters.index_offset + abs(total)))


def transmission(errors=(), first=0, characters=22):
    blank = not_found(TEXT, FRAME)
    return replace(
        blank, start_ns=1_000_000_000, bit_rate_bps=1100.0, first=first, characters=characters, wrong=len(errors), missing=0,
        errors=tuple(errors),
    )  # fmt: skip


def test_a_stretch_is_chosen_around_an_error_else_in_the_middle() -> None:
    character = Character(1_100_000_000, 33, Status.OK, 1.0, 0, 1100.0)
    wrong = CharacterError(10, 1_100_000_000, 65, character)
    found = choose_stretch({'a': [transmission()], 'b': [transmission([wrong])]}, (), FRAME)
    assert found is not None and '`b` reads wrong' in found.why
    sent = sent_within([transmission()], TEXT, found, FRAME)
    assert [chr(code) for _, code in sent] == list(TEXT[9:13])
    middle = choose_stretch({'a': [transmission()]}, (), FRAME)
    assert middle is not None and 'middle of its longest' in middle.why
    last = CharacterError(21, 0, 65, character)
    at_end = choose_stretch({'a': [transmission([last])]}, (), FRAME)
    assert at_end is not None
    assert [chr(code) for _, code in sent_within([transmission()], TEXT, at_end, FRAME)] == list(TEXT[18:22])
    decoded = choose_stretch({}, [character], FRAME)
    assert decoded is not None and decoded.begin_ns < character.t_ns < decoded.end_ns
    assert choose_stretch({}, (), FRAME) is None
    missing = choose_stretch({'a': [transmission([CharacterError(10, 0, 65, None)])]}, (), FRAME)
    assert missing is not None and 'middle' in missing.why


def test_numbers_for_the_curves() -> None:
    right = np.array([1, 1, 0, 1], bool)
    assert rolling_share(right, 2).tolist() == [1.0, 1.0, 0.5, 0.5]
    spiky = np.zeros(1000)
    spiky[[137, 700]] = 5.0, -3.0
    kept = extremes(spiky, 20)
    assert {0, 137, 700, 999} <= set(kept.tolist()) and len(kept) <= 42
    assert extremes(spiky[:30], 20).tolist() == list(range(30))
    assert (nines(0.0), nines(0.99), nines(1.0)) == (0.0, pytest.approx(2.0), 6.0)


def test_text_is_escaped_and_figures_do_not_share_names() -> None:
    import matplotlib

    page = Page('<b>title', 'lead')
    page.section('a & b')
    page.table(('recording', 'value'), [('<x>', '1 [0, 2]')])
    with matplotlib.rc_context(STYLE):
        for _ in range(2):
            figure = new_figure(3.0, 2.0)
            figure.subplots().plot([0, 1], [0, 1])
            page.figure(figure, 'a caption', 'alt "text"')
        assert inline_svg(figure, 'p', 'x') == inline_svg(figure, 'p', 'x')
    outline = check(page.html())
    assert '<b>title' in outline.text and '<x>' in outline.text and 'a & b' in outline.text
    assert outline.count['svg'] == 2
    assert '<span class=interval>[0, 2]</span>' in page.html()
