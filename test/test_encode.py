"""beacon_encode: the paper's example, transitions, pictures, refusals."""

import io
import json
import re
import signal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beacon_comm.cli.encode import main
from beacon_comm.cli.interrupts import interrupts_held
from beacon_comm.cli.waveform import terminal_waveform
from beacon_comm.core.framing import CharacterFrame


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    try:
        code = main(arguments)
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_papers_figure_1(capsys) -> None:
    code, out, _ = run(capsys, 'S')
    assert code == 0
    assert "83  0     1010011 0      11    'S'" in out
    assert '11 bits, 504 bit/s' in out


def test_a_line_feed_has_a_visible_name(capsys) -> None:
    _, out, _ = run(capsys, 'a\n')
    assert "10  0     0001010 0      11    '\\n'" in out


def test_csv_holds_the_transitions(capsys) -> None:
    code, out, _ = run(capsys, 'S', '--bit-rate', '1000', '--output-format', 'csv')
    assert code == 0
    assert out.split() == [
        'time_s,level', '0.000000000,0', '0.001000000,1', '0.002000000,0', '0.003000000,1', '0.004000000,0',
        '0.006000000,1', '0.008000000,0', '0.009000000,1',
    ]  # fmt: skip


def test_json_holds_everything_and_levels_give_the_bits_back(capsys) -> None:
    code, out, _ = run(capsys, 'Beacon', '--output-format', 'json', '--bit-rate', '3125')
    content = json.loads(out)
    assert code == 0
    assert content['bits'] == ''.join(str(bit) for bit in CharacterFrame().encode_bits('Beacon'))
    assert [entry['code'] for entry in content['characters']] == [ord(symbol) for symbol in 'Beacon']
    assert content['characters'][2]['start_s'] == pytest.approx(22 / 3125)
    times, levels = (np.array(column) for column in zip(*content['transitions'], strict=True))
    middles = (np.arange(66) + 0.5) / 3125
    level_at = levels[np.searchsorted(times, middles) - 1]
    assert ''.join(str(int(level)) for level in level_at) == content['bits']


def test_the_frames_options(capsys) -> None:
    options = ('--data-bits', '8', '--parity', 'none', '--stop-bits', '1', '--bit-order', 'lsb_first')
    code, out, _ = run(capsys, 'é', *options, '--output-format', 'json')
    assert code == 0
    assert json.loads(out)['bits'] == '0' + '10010111' + '1'


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (('Grüße',), r"beacon_encode: 'ü' \(U\+00FC\) at position 2"),
        (('',), 'no text'),
        (('S', '--parity', 'mark'), 'parity'),
        (('S', '--data-bits', '9'), 'data_bits'),
        (('S', '--bit-rate', '0'), r'^beacon_encode: --bit-rate 0\.0: must lie in \[20, 10000\]'),
        (('S', '--bit-rate', 'fast'), '--bit-rate'),
        (('S', '--plot', '/absent/folder/w.png'), r'/absent/folder/w\.png: cannot be written'),
        (('S', '--plot', 'w.sound'), r'w\.sound: cannot be written'),
        ((), 'TEXT'),
    ],
)
def test_errors_are_one_line_and_exit_code_2(capsys, arguments, complaint) -> None:
    code, out, err = run(capsys, *arguments)
    assert code == 2
    assert out == ''
    assert err.count('\n') == 1
    assert re.search(complaint, err)


def test_an_interrupted_picture_is_one_line(capsys, monkeypatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr('beacon_comm.cli.encode.save_waveform', interrupted)
    assert run(capsys, 'S', '--plot', 'w.png') == (2, '', 'beacon_encode: interrupted\n')


def test_an_interrupt_waits_for_libraries() -> None:
    loaded = False
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        signal.raise_signal(signal.SIGINT)
        loaded = True
    assert loaded


def test_text_from_standard_input(capsys, monkeypatch) -> None:
    monkeypatch.setattr('sys.stdin', io.StringIO('SOS\n'))
    code, out, _ = run(capsys, '-', '--output-format', 'json')
    assert code == 0
    assert json.loads(out)['text'] == 'SOS\n'


def test_the_picture_is_an_image_of_some_size(capsys, tmp_path) -> None:
    from matplotlib.image import imread

    file = tmp_path / 'wave.png'
    code, _, _ = run(capsys, 'Hello, beacon!\n' * 20, '--plot', str(file))
    image = imread(file)
    assert code == 0
    assert image.shape[0] > 1000
    assert image.shape[1] == 1400
    assert image[:, :, :3].std() > 0.05


def level_line(drawn: str) -> str:
    """Read the bits back from the upper line of a drawing: the column after each cell's edge."""
    upper, values = drawn.split('\n')[1], drawn.split('\n')[3]
    count = len(values.split())
    return ''.join('1' if upper[1 + 3 * k + 1 : 1 + 3 * k + 2] == '─' else '0' for k in range(count))


@given(st.text(st.characters(max_codepoint=127), min_size=1, max_size=3))
def test_the_terminals_waveform_reads_back(text) -> None:
    frame = CharacterFrame()
    bits = frame.encode_bits(text)
    drawn = terminal_waveform(text, bits, frame, 1000)
    assert level_line(drawn) == ''.join(str(bit) for bit in bits)
    assert drawn.split('\n')[3].split() == [str(bit) for bit in bits]


def test_the_terminals_waveform_wraps(capsys, monkeypatch) -> None:
    monkeypatch.setenv('COLUMNS', '80')
    _, out, _ = run(capsys, 'SOSOS', '--plot')
    drawing = out.split('\n\n', 2)[2]
    assert max(len(line) for line in drawing.splitlines()) <= 80
    assert drawing.count("'S'") == 3
