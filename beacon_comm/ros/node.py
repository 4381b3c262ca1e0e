"""``beacon_node``: starts the node, keeps it running, ends it.

Exit code 0 after Ctrl-C (once or twice: ``ros2 launch`` sends a second one) and SIGTERM, 2 when a parameter or the
calibration is refused.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

EXIT_REFUSED = 2


class StopSignal:
    """SIGINT and SIGTERM: interrupt the start, then only ask the running node to end; later ones change nothing.

    rclpy's own handlers would take the publishers away before the last characters are out.
    """

    def __init__(self) -> None:
        self.requested = False
        self._starting = True
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def started(self) -> None:
        """From now on a signal interrupts nothing."""
        self._starting = False

    def ignore(self) -> None:
        """Let no further signal cut the end short: Python itself would die of one once it takes its handlers down."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        if self._starting:
            self._starting = False
            raise KeyboardInterrupt


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; return the exit code."""
    stop = StopSignal()
    try:
        return _run(args, stop)
    except KeyboardInterrupt:
        return 0
    finally:
        stop.ignore()


def _with_a_log(args: Sequence[str]) -> list[str]:
    """Return the arguments; where the folder for logs cannot be made, without which rcl would not start, with none wanted."""
    folder = os.environ.get('ROS_LOG_DIR') or os.path.join(os.environ.get('ROS_HOME') or '~/.ros', 'log')
    if folder.startswith('~'):
        folder = os.environ.get('HOME', '/proc/no home') + folder[1:]  # rcl asks nobody else
    try:
        os.makedirs(folder, exist_ok=True)
        kept = os.access(folder, os.W_OK)
    except OSError:
        kept = False
    if kept:
        return list(args)
    print(f'{folder} cannot be written, no log is kept (ROS_LOG_DIR)', file=sys.stderr)
    return [*args, '--ros-args', '--disable-external-lib-logs']


def _run(args: Sequence[str] | None, stop: StopSignal) -> int:
    from beacon_comm.compiling.cache import ensure_compiler_cache

    ensure_compiler_cache()  # before anything imports numba
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from beacon_comm.core.errors import BeaconCommError
    from beacon_comm.ros.beacon_node import NODE_NAME, BeaconNode

    try:
        rclpy.init(args=_with_a_log(sys.argv if args is None else args), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl's own: a parameter file or rule that cannot be parsed
        print(f'{NODE_NAME}: {str(error).splitlines()[0]}', file=sys.stderr)
        return EXIT_REFUSED
    node = None
    try:
        node = BeaconNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        stop.started()
        gc.collect()
        gc.freeze()  # what stays for good, the compiler's above all, need not be gone through again: a tenth of a second
        while rclpy.ok() and not stop.requested:
            try:
                executor.spin_once()  # the node's timers bound the wait
            except ExternalShutdownException:
                raise
            except Exception:
                node.survive('spin_once')  # a /clock of negative time, for one, is rclpy's own business
    except BeaconCommError as error:
        rclpy.logging.get_logger(NODE_NAME).fatal(str(error))
        return EXIT_REFUSED
    except ExternalShutdownException:
        pass
    finally:
        stop.ignore()
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
