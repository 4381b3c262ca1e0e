"""The scenes without a beacon of docs/distractor_scenes.py, on short ones."""

import pytest
from docs_script import load

scenes = load('distractor_scenes')


def families(tmp_path):
    return scenes.families(tmp_path)  # no recordings there


@pytest.mark.parametrize('name', [name for name in (*scenes.FAMILIES, scenes.CONTROL) if 'recorded' not in name])
def test_every_family_draws_scenes_that_can_be_simulated(name, tmp_path):
    count = scenes.watch(name, 0, 3, 0.03, tmp_path)
    assert count.scenes == 1 and count.events > 0.0 and count.confirmed == 0
    assert count == scenes.watch(name, 0, 3, 0.03, tmp_path)
    assert count != scenes.watch(name, 1, 3, 0.03, tmp_path)


def test_without_the_recordings_there_is_no_recorded_room(tmp_path):
    assert len(families(tmp_path)) == len(scenes.FAMILIES)


def test_a_beacon_among_everything_is_confirmed_and_named(tmp_path):
    count = scenes.watch(scenes.CONTROL, 1, 0, 0.6, tmp_path)
    assert count.confirmed == 1 and count.named == (1,) and count.ok > 12


def test_the_page_counts_what_was_confirmed_without_a_beacon_but_not_the_control(tmp_path):
    found = dict.fromkeys(families(tmp_path), scenes.Count(1, 1800.0, 2.0, 3, 1, 20, 10))
    found['lamps'] += scenes.Count(confirmed=1, named=(7,))
    found[scenes.CONTROL] += scenes.Count(confirmed=4, named=(0,))
    page = scenes.text_of(found, 'the command')
    assert 'In 2.50 h of scenes' in page
    assert 'without one, 1 were: 0.01 to 2.2 an hour' in page  # 0.0253 to 5.57 in all (Poisson)
    assert 'Confirmed in scenes of lamps: 7.' in page
