"""YAML texts: what they hold, and one kind of error for everything else."""

from pathlib import Path

import pytest

from beacon_comm.cli.evaluate import main as evaluate
from beacon_comm.cli.simulate import main as simulate
from beacon_comm.core.yaml_text import load_yaml

DEEP = '[' * 3000


def test_numbers_and_texts() -> None:
    text = 'a: [1, -2.5, 0x10, 18446744073709551615, yes, 2001-01-01, ~, "1"]'
    assert load_yaml(text)['a'][:5] == [1, -2.5, 16, 2**64 - 1, True]
    assert load_yaml('') is None


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        (DEEP, 'nested too deeply'),
        ('a: [', 'while parsing'),
        ('a: ' + '9' * 5000, 'integer string'),
        ('a: 0x' + 'f' * 4000, 'more than 64 bits'),
        ('2001-13-45', 'month'),
        ('!!int ""', 'index'),
        ('!!python/object/apply:os.system ["id"]', 'could not determine a constructor'),
    ],
)
def test_everything_else_is_one_error(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as caught:
        load_yaml(text)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('content', [DEEP, 'duration_s: 0x' + 'f' * 4000, 'image_width: ' + '9' * 5000])
@pytest.mark.parametrize('option', ['--params', '--camera', 'scene'])
def test_a_file_of_it_is_one_line(content: str, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / 'file.yaml'
    file.write_text(content)
    if option == 'scene':
        assert simulate([str(file), '--output', str(tmp_path / 'out')]) == 2
    else:
        assert evaluate(['x.mat', option, str(file)]) == 2
    error = capsys.readouterr().err
    assert str(file) in error and error.count('\n') == 1


def test_a_bag_with_such_metadata_is_read_without_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'metadata.yaml').write_text(DEEP)
    assert evaluate([str(tmp_path)]) == 2
    assert 'no .mcap or .db3 file in this folder' in capsys.readouterr().err
