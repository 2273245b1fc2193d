# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Process of the node, from arguments to stop signal."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Sequence

import rclpy
from rclpy.exceptions import InvalidParameterException, NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from cloth_sim_ros.ros.io.transports import cloud_transports
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.ros.process.arguments import ArgumentsError, error_text, read_and_start
from cloth_sim_ros.ros.process.command_line_parameters import command_line_parameters, unused_files
from cloth_sim_ros.ros.process.failure import NodeFailedError
from cloth_sim_ros.ros.process.options import parser
from cloth_sim_ros.ros.process.stopping import StopRequestedError, StopSignals
from cloth_sim_ros.ros.process.worker_thread import WorkerThread
from cloth_sim_ros.ros.recording.errors import RecordingUnavailableError
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.parameters.declare import ParameterError

_BAD_NAMES = (InvalidParameterException, NameValidationException)
#: Errors that rclpy raises for a malformed message of a type that it takes itself (/clock, parameter requests). They
#: have no public name.
_TAKE_ERRORS = ("RCLError", "RMWError")


def run(argv: Sequence[str], signals: StopSignals) -> int:
    """Run the node until a signal or a failure ends it; return the exit status, or exit here if a job is abandoned.

    Args:
        argv: the command line, including the command.
        signals: the installed signal handlers.

    Returns:
        Exit status: 0 if a signal stopped the node; 1 if it could not start, its recording could not be closed, or a
        frame failed and `on_failure` is `exit`.
    """
    worker = WorkerThread(signals.name)
    # In force until the node has joined the graph; later child processes get the original environment.
    joining = contextlib.ExitStack()
    try:
        warning = joining.enter_context(cloud_transports(command_line_parameters(argv)))
        read_and_start(parser(), argv)
        status = _run(argv, signals, worker, joining, warning)
    except ArgumentsError as error:
        return _refuse(str(error))
    finally:
        signals.ignore()
        joining.close()
        rclpy.try_shutdown()
    if worker.is_abandoned:
        worker.end_process(status)
    return status


def _run(
    argv: Sequence[str], signals: StopSignals, worker: WorkerThread, joining: contextlib.ExitStack, warning: str
) -> int:
    try:
        # In the worker thread: a signal interrupts only the wait, because exceptions in rclpy's callbacks are lost.
        cloth = worker.run(lambda: ClothNode(run_job=worker.run, signal_name=signals.name))
        joining.close()
    except StopRequestedError:
        signals.report_early_stop()
        if worker.is_abandoned:
            worker.end_process(0)
        return 0
    except ParameterError as error:
        return _refuse(*error.sentences)
    except (ValueError, RuntimeError, *_BAD_NAMES) as error:
        return _refuse(error_text(error))
    if warning:
        cloth.node.get_logger().warning(warning)
    started = failed = False
    try:
        cloth.warm_up()
        # Exclude the permanent objects of libraries from garbage collection, which would delay frames by tens of
        # milliseconds.
        gc.collect()
        gc.freeze()
        cloth.start()
        started = True
        # After the start, because reading a file a second time takes a while.
        for sentence in unused_files(argv, node=cloth.node.get_fully_qualified_name()):
            cloth.node.get_logger().warning(sentence)
        _spin(cloth, signals)
    except StopRequestedError:
        signals.report_early_stop()
    except ParameterError as error:
        if started:
            raise
        return _refuse(*error.sentences)
    except NodeFailedError as error:
        failed = True
        cloth.node.get_logger().error(str(error))
    except (RecordingUnavailableError, ValueError, *_BAD_NAMES) as error:
        if started:
            raise
        return _refuse(error_text(error))
    finally:
        saved = cloth.close()
        if cloth.frame_aborted:
            worker.abandon()
    return 0 if saved and not failed else 1


def _spin(cloth: ClothNode, signals: StopSignals) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(cloth.node)
    log = ThrottledLog(cloth.node.get_logger())
    while signals.requested is None:
        try:
            executor.spin_once()
        except ExternalShutdownException:
            return
        except StopRequestedError:
            # Raised while waiting for the end of a frame.
            break
        except RuntimeError as error:
            if type(error).__name__ not in _TAKE_ERRORS:
                raise
            log.error("take", f"a message could not be taken and is left out: {error}")
    # Frames must log nothing after the next line.
    cloth.stop()
    cloth.node.get_logger().info(f"{signals.name()}: stopping")


def _refuse(*reasons: str) -> int:
    for reason in reasons:
        print(f"cloth_sim: {reason}", file=sys.stderr)
    return 1
