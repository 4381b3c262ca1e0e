"""``beacon_evaluate``: the receiver over recordings, without ROS, and its scores against a known text."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from beacon_comm.cli.parameter_arguments import add_parameter_arguments, parameters_from
from beacon_comm.cli.parser import EXIT_ERROR, EXIT_OK, LONGEST_S, OneLineParser
from beacon_comm.core.errors import BeaconCommError, CalibrationError, ParameterError, RecordingError
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.report import (
    beacons_table,
    listed,
    published_table,
    recordings_table,
    scores_table,
    summary_table,
    texts_table,
    tracking_table,
)
from beacon_comm.evaluation.result import RecordingResult
from beacon_comm.evaluation.result_json import write_json
from beacon_comm.evaluation.truth import load_truth

if TYPE_CHECKING:
    from beacon_comm.core.bearing import CameraModel

NAME = 'beacon_evaluate'
NO_TRUTH = 'none'


def make_parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    parser = OneLineParser(
        prog=NAME,
        description='Run the receiver over recordings as fast as it goes, and score what it decodes.',
        epilog='Exit code 0: all was read; 2: an error, or something could not be read (the rest is shown).',
    )
    parser.add_argument(
        'recordings',
        metavar='RECORDING',
        nargs='*',
        help="a bag (rosbag2, ROS 1) or a .mat file of one beacon's events (with --stress by default the paper's at 30 m)",
    )
    parser.add_argument(
        '--truth',
        metavar='TEXT',
        help="what was sent: sonnet18, a text file (every byte of it counts), or the text; a scene's truth.json beside a bag is"
        ' found by itself; none: not even that',
    )
    add_parameter_arguments(parser)
    parser.add_argument('--camera', metavar='YAML', help='calibration of the camera, for bearings')
    parser.add_argument(
        '--report', metavar='DIR', help='write a page of tables and figures there, index.html; with --receiver A,B of both'
    )
    parser.add_argument('--json', metavar='FILE', help='write the results there, too (docs/evaluation.md)')
    parser.add_argument('--topic', help='event topic of the bags (default: the only one)')
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='seconds of each recording to leave out')
    parser.add_argument('--duration', type=float, metavar='S', help='seconds to evaluate (default: to the end)')
    stress = parser.add_argument_group('stress', 'Every receiver over waveforms made harder to read, step by step.')
    stress.add_argument(
        '--stress', metavar='DIR', help='write stress.md, stress.json and figures/stress_*.png there (some minutes)'
    )
    stress.add_argument('--stress-only', metavar='NAME[,NAME…]', help='stresses to run (default: all), e.g. thinned,clock')
    stress.add_argument(
        '--stress-simulated',
        metavar='BPS[,BPS…]',
        help='bit rates to simulate the truth at, beside the recordings; none: only the recordings (default: 504,1000,3125)',
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser()
    arguments = parser.parse_args(argv)
    if not arguments.recordings and arguments.stress is None:
        parser.error('the following arguments are required: RECORDING')
    try:
        if arguments.stress is not None:
            return _stress(arguments)
        return _run(arguments, sys.argv[1:] if argv is None else argv)
    except BeaconCommError as error:
        return _complain(str(error))
    except KeyboardInterrupt:
        return _complain('interrupted')
    except BrokenPipeError:
        sys.stderr.close()  # the reader has gone: nothing to say, and nobody to say it to
        return EXIT_ERROR


def _run(arguments: argparse.Namespace, words: Sequence[str]) -> int:
    # Imported here: the kernels' libraries take a second, and --help and wrong arguments need none of them.
    from beacon_comm.cli.offline import Options, evaluate_recording, is_mat
    from beacon_comm.compiling.warm_up import warm_up

    if not 0.0 <= arguments.start <= LONGEST_S:
        raise ParameterError(f'--start {arguments.start:g}: must be from 0 to {LONGEST_S:g} s')
    if arguments.duration is not None and not 0.0 < arguments.duration <= LONGEST_S:
        raise ParameterError(f'--duration {arguments.duration:g}: must be above 0, at most {LONGEST_S:g} s')
    _check_writable(arguments.json)
    receivers = [None] if arguments.receiver is None else arguments.receiver.split(',')
    settings: dict[str, Parameters] = {}
    passed_over: list[str] = []
    for receiver in receivers:
        parameters, passed_over = parameters_from(argparse.Namespace(**{**vars(arguments), 'receiver': receiver}))
        settings[parameters.receiver] = parameters
    parameters = next(iter(settings.values()))
    folder = None if arguments.report is None else _report_folder(arguments.report)
    if passed_over:
        print(f"{NAME}: {arguments.params}: not the receiver's, passed over: {', '.join(passed_over)}", file=sys.stderr)
    truth, camera = _truth(arguments.truth, parameters), _camera(arguments.camera)
    options = {
        receiver: Options(
            own, truth, camera, arguments.topic, arguments.start, arguments.duration, arguments.truth != NO_TRUTH
        )
        for receiver, own in settings.items()
    }
    for own in settings.values():
        warm_up(own, pixels=not all(map(is_mat, arguments.recordings)))
    groups: list[list[RecordingResult]] = []
    code = EXIT_OK
    for recording in arguments.recordings:
        try:
            groups.append([evaluate_recording(recording, own) for own in options.values()])
        except BeaconCommError as error:
            code = _complain(str(error))
            continue
        problem = groups[-1][0].problem
        if problem is not None:
            code = _complain(problem)
    results = [result for group in groups for result in group]
    if results:
        comparable = arguments.start == 0.0 and arguments.duration is None and arguments.truth == 'sonnet18'
        print_results(results, truth is not None, comparable)
        if arguments.json is not None:
            write_json(arguments.json, results)
        if folder is not None:
            from beacon_comm.cli.report_page import write_report  # loads the drawing

            path = write_report(folder, groups, options, shlex.join([NAME, *words]), comparable)
            print(f'{NAME}: wrote {path}', file=sys.stderr)
    return code


def _report_folder(name: str) -> Path:
    """Make the report's folder before anything is evaluated."""
    from beacon_comm.evaluation.stress_report import require_matplotlib

    require_matplotlib()
    return _writable_folder('--report', name)


def _writable_folder(option: str, name: str) -> Path:
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f'{option} {folder}: cannot be made ({error.strerror})') from error
    if not os.access(folder, os.W_OK):
        raise RecordingError(f'{option} {folder}: cannot be written (no permission)')
    return folder


def _stress(arguments: argparse.Namespace) -> int:
    """Measure every receiver under stress; write the tables and figures, and print the summary."""
    from beacon_comm.evaluation.stress_report import require_matplotlib, summary_table, write_report

    for name in ('camera', 'json', 'report', 'topic', 'start', 'duration'):
        if getattr(arguments, name) != (0.0 if name == 'start' else None):
            raise RecordingError(f'--{name} and --stress do not go together')
    parameters, _ = parameters_from(arguments)
    simulated_bps = _simulated_rates(arguments.stress_simulated, parameters)
    truth = _truth(arguments.truth or 'sonnet18', parameters) or ''
    folder = _writable_folder('--stress', arguments.stress)
    require_matplotlib()
    from beacon_comm.cli.stress import SIMULATED_BPS, default_recordings, run_stress  # loads the kernels

    recordings = arguments.recordings or default_recordings()
    if not recordings:
        print(f'{NAME}: no recordings given and none in BEACON_COMM_DATA: simulated waveforms only', file=sys.stderr)
    results = run_stress(
        recordings,
        truth,
        parameters,
        only=None if arguments.stress_only is None else arguments.stress_only.split(','),
        receivers=None if arguments.receiver is None else [arguments.receiver],
        simulated_bps=SIMULATED_BPS if simulated_bps is None else simulated_bps,
    )
    print(summary_table(results))
    for path in write_report(folder, results, _command(arguments)):
        print(f'{NAME}: wrote {path}', file=sys.stderr)
    return EXIT_OK


def _simulated_rates(text: str | None, parameters: Parameters) -> tuple[float, ...] | None:
    if text is None:
        return None
    if text == 'none':
        return ()
    try:
        rates = tuple(float(rate) for rate in text.split(','))
        return replace(parameters, bit_rates=rates).bit_rates
    except (ValueError, ParameterError) as error:
        raise ParameterError(f'--stress-simulated {text}: must be bit rates with commas between them, or none') from error


def _command(arguments: argparse.Namespace) -> str:
    """Return the command line for the page, paths without the folders of this machine."""
    words = [NAME, *(f'…/{Path(recording).name}' for recording in arguments.recordings)]
    options = {'truth': '--truth', 'receiver': '--receiver', 'bit_rate': '--bit-rate', 'params': '--params'}
    options |= {'stress_only': '--stress-only', 'stress_simulated': '--stress-simulated'}
    for name, option in options.items():
        value = getattr(arguments, name)
        if value is not None:
            is_file = name in ('truth', 'params') and os.path.isfile(value)
            words += [option, f'…/{Path(value).name}' if is_file else shlex.quote(value)]
    for setting in arguments.set:
        words += ['--set', shlex.quote(setting)]
    return ' '.join([*words, '--stress', Path(arguments.stress).name or '.'])


def print_results(results: Sequence[RecordingResult], scored: bool, comparable: bool) -> None:
    """Print the tables of one or several recordings.

    Args:
        results: at least one.
        scored: whether there was a truth.
        comparable: whether they can stand beside the paper's figures.
    """
    print(recordings_table(results))
    if any(listed(result) for result in results):
        print('\n' + texts_table(results))
    if any(result.scene is not None for result in results):
        print('\nAgainst the truth beside the bag, brackets are 95 % intervals:\n' + beacons_table(results))
        print('\n' + tracking_table(results))
        summary = summary_table(results)
        if summary is not None:
            print('\nAll scenes, means and their intervals from scene to scene:\n' + summary)
    if scored and any(beacon.transmissions for result in results for beacon in result.beacons):
        print('\n' + scores_table(results))
        published = published_table(results) if comparable else None
        if published is not None:
            print("\nThe last transmission beside the paper's figures (section IV, outdoor):\n" + published)
    elif scored:
        print('\nNo transmission of the text was found: message accuracy 0, bit accuracy 0.5.')


def _truth(argument: str | None, parameters: Parameters) -> str | None:
    """Return the text; one that cannot have been sent is refused before anything is read."""
    if argument is None or argument == NO_TRUTH:
        return None
    text = load_truth(argument)
    CharacterFrame.from_parameters(parameters).encode_bits(text)
    return text


def _camera(path: str | None) -> CameraModel | None:
    if path is None:
        return None
    from beacon_comm.core.bearing import CameraModel

    try:
        return CameraModel.from_yaml(path)
    except CalibrationError as error:
        if isinstance(error.__cause__, OSError):
            raise CalibrationError(f'--camera {path}: cannot be read ({error.__cause__.strerror})') from error
        raise CalibrationError(f'--camera {error}') from error


def _check_writable(name: str | None) -> None:
    """Refuse a file that cannot be written in the end, before anything is evaluated; nothing is made yet."""
    if name is None:
        return
    file = Path(name)
    if os.path.isdir(file):
        why = 'is a folder'
    elif not os.path.isdir(file.parent):
        why = 'no such folder'
    elif not os.access(file if os.path.lexists(file) else file.parent, os.W_OK):
        why = 'no permission'
    else:
        return
    raise RecordingError(f'--json {name}: cannot be written ({why})')


def _complain(text: str) -> int:
    print(f'{NAME}: {" ".join(text.split())}', file=sys.stderr)
    return EXIT_ERROR


if __name__ == '__main__':
    sys.exit(main())
