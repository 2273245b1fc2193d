# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast DDS transports of a node: a shared-memory segment for its clouds.

The segment is large enough for the unread clouds of suspended subscribers.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene.config_files import config_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

#: Time after which Fast DDS drops a suspended subscriber [s].
_LEASE_TIME = 3.0
#: Largest number of buffers that wait for one subscriber, and largest buffer [bytes]; longer messages are split.
_QUEUE_LENGTH, _LARGEST_BUFFER = 512, 65_500
#: Frames whose messages are in transit.
_FRAMES_IN_TRANSIT = 4
#: Size for all small messages: wrenches, states, diagnostics, discovery [bytes].
_SMALL_MESSAGES = 1 << 20
#: Smallest and largest segment [bytes].
_MIN_SEGMENT, _MAX_SEGMENT = 1 << 20, 64 << 20
#: Largest fraction of the free shared memory: other processes need ports and segments too.
_MAX_MEMORY_FRACTION = 0.5
#: Smallest segment as a fraction of the required size; a smaller one fills too soon.
_MIN_SEGMENT_FRACTION = 0.25
#: Smallest size of a particle in a file of a mesh or of springs [bytes].
_FILE_BYTES_A_PARTICLE = 30
_SHARED_MEMORY = Path("/dev/shm")
_PROFILE, _PROFILE_SEGMENT = "fastdds_large_clouds.xml", str(16 << 20)
_PROFILES_FILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_BUILTIN = "FASTDDS_BUILTIN_TRANSPORTS"
_RANGE, _ONLY_LOCAL, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS"
#: Variables by which users choose their own transports.
_USERS_VARIABLES = (_PROFILES_FILE, "FASTDDS_DEFAULT_PROFILES_FILE", _BUILTIN, "RMW_FASTRTPS_USE_QOS_FROM_XML")
#: Files that Fast DDS reads in the working directory, unless the variables below disable it.
_USERS_FILES = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")
_SKIP_FILES = ("SKIP_DEFAULT_XML_FILE", "SKIP_DEFAULT_XML")


@contextlib.contextmanager
def cloud_transports(*cloths: Mapping[str, Any]) -> Iterator[str]:
    """Context whose environment makes Fast DDS give the first node shared memory for clouds; yields a warning or "".

    Within this context, initialize rclpy and create the node. Nothing changes if the user chose transports or another
    middleware.

    Args:
        cloths: parameters of each cloth by full name; missing ones have their defaults.

    Yields:
        A warning if the shared memory is too small and UDP is used instead; otherwise an empty text.
    """
    with _segment(lambda: sum(segment_bytes(values) for values in cloths)) as warning:
        yield warning


@contextlib.contextmanager
def large_segment(message_bytes: int, rate: float) -> Iterator[str]:
    """Context, as `cloud_transports`, for messages of a total size [bytes] that are sent at a rate [Hz]."""
    with _segment(lambda: _segment_size(message_bytes, message_bytes, rate)) as warning:
        yield warning


@contextlib.contextmanager
def _segment(requested: Callable[[], int]) -> Iterator[str]:
    with contextlib.ExitStack() as stack:
        yield _set_segment(stack, requested()) if not _has_users_transports() else ""


def segment_bytes(parameters: Mapping[str, Any]) -> int:
    """Return the size of the shared-memory segment that a cloth's outputs need [bytes].

    Args:
        parameters: by full name; missing and invalid ones have their defaults.
    """
    cloud, mesh, rate = _output_bytes(parameters)
    return _segment_size(cloud, cloud + mesh, rate)


def _segment_size(unread_bytes: int, sent_bytes: int, rate: float) -> int:
    """Return the size of a segment [bytes] for messages that are sent at a rate [Hz].

    Args:
        unread_bytes: size of the messages of a frame that are held, unread, for suspended subscribers. Fast DDS
            overwrites others.
        sent_bytes: size of all messages of a frame.
        rate: rate of the frames [Hz].
    """
    unread = min(_LEASE_TIME * rate * unread_bytes, _QUEUE_LENGTH * _LARGEST_BUFFER)
    size = int(unread) + _FRAMES_IN_TRANSIT * sent_bytes + _SMALL_MESSAGES
    return min(max(size, _MIN_SEGMENT), _MAX_SEGMENT)


def _output_bytes(parameters: Mapping[str, Any]) -> tuple[int, int, float]:
    """Return the sizes of a cloud and of a mesh marker [bytes], and the frame rate [Hz]."""
    entries = {entry.name: entry for entry in Scene.declared_for(())}

    def value(name: str) -> Any:
        with contextlib.suppress(ParameterError):
            return entries[name].check(parameters.get(name, entries[name].default))
        return entries[name].default

    rows, columns = value("cloth.resolution")
    particles, triangles = rows * columns, 2 * (rows - 1) * (columns - 1)
    for name in (value("cloth.mesh"), value("cloth.springs")):
        with contextlib.suppress(OSError, ValueError):
            if name:
                # A bound from the file's size, because reading the file twice would delay the first cloud.
                particles = os.stat(name).st_size // _FILE_BYTES_A_PARTICLE
                triangles = 2 * particles
    vector_count = 1 + value("points.velocity") + value("points.normal")
    point_bytes = 3 * vector_count * (8 if value("points.double") else 4) + 4 * value("points.id")
    return particles * point_bytes, triangles * 72, float(value("rate"))


def _has_users_transports() -> bool:
    from rclpy.utilities import get_rmw_implementation_identifier

    if not get_rmw_implementation_identifier().startswith("rmw_fastrtps") or not _SHARED_MEMORY.is_dir():
        return True
    if any(os.environ.get(name) for name in _USERS_VARIABLES):
        return True
    skipped = any(os.environ.get(name, "").startswith("1") for name in _SKIP_FILES)
    return not skipped and any(os.path.exists(name) for name in _USERS_FILES)


def _set_segment(stack: contextlib.ExitStack, requested: int) -> str:
    """Set the environment, until ``stack`` closes, for a segment [bytes], or UDP if short; return a warning or ""."""
    requested = min(requested, _MAX_SEGMENT)
    try:
        status = os.statvfs(_SHARED_MEMORY)
        free = status.f_bavail * status.f_frsize
        size = min(requested, int(free * _MAX_MEMORY_FRACTION))
        if size >= _MIN_SEGMENT_FRACTION * requested:
            text = config_file(_PROFILE).read_text().replace(_PROFILE_SEGMENT, str(size))
            _set_variables(stack, {_PROFILES_FILE: _write(stack, text)})
            return ""
        _set_variables(stack, _udp_variables(stack))
    except OSError as error:
        return (
            f"no shared-memory segment for clouds: {error}; a suspended subscriber may silence the clouds of all "
            f"others: give {_PROFILES_FILE} a profile"
        )
    return (
        f"{_SHARED_MEMORY} has {free / 1e6:.3g} MB free, clouds need a segment of {requested / 1e6:.3g} MB and as much "
        f"for others: they go by UDP, which loses clouds above 200 kB; enlarge {_SHARED_MEMORY} (docker: --shm-size), "
        f"or remove what ended processes left there (fastrtps_*)"
    )


def _udp_variables(stack: contextlib.ExitStack) -> dict[str, str | None]:
    """Return environment variables that restrict Fast DDS to UDP; None for one to remove. May write a profile."""
    local = os.environ.get(_ONLY_LOCAL) == "1" or os.environ.get(_RANGE, "").upper() == "LOCALHOST"
    if not local:
        return {_BUILTIN: "UDPv4"}
    # rmw_fastrtps adds shared memory to the range LOCALHOST. Therefore a profile replaces that range.
    peers = ["127.0.0.1", *filter(None, os.environ.get(_PEERS, "").split(";"))]
    return {_PROFILES_FILE: _write(stack, _local_udp_profile(peers)), _RANGE: "SYSTEM_DEFAULT", _ONLY_LOCAL: None}


def _write(stack: contextlib.ExitStack, text: str) -> str:
    file = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cloth_sim_ros_"))) / "fastdds.xml"
    file.write_text(text)
    return str(file)


def _set_variables(stack: contextlib.ExitStack, variables: Mapping[str, str | None]) -> None:
    """Set environment variables, or remove those without a value, until the stack is closed."""
    for name, value in variables.items():
        before = os.environ.get(name)
        stack.callback(_set_variable, name, before)
        _set_variable(name, value)


def _set_variable(name: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value


def _local_udp_profile(peers: list[str]) -> str:
    """Return a Fast DDS profile (XML) equal to the discovery range LOCALHOST, without shared memory."""
    locators = "".join(f"<locator><udpv4><address>{peer}</address></udpv4></locator>" for peer in peers)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>udp</transport_id><type>UDPv4</type><maxInitialPeersRange>32</maxInitialPeersRange>
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="local_udp" is_default_profile="true">
      <rtps>
        <userTransports><transport_id>udp</transport_id></userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>
        <builtin>
          <metatrafficUnicastLocatorList><locator><udpv4/></locator></metatrafficUnicastLocatorList>
          <initialPeersList>{locators}</initialPeersList>
        </builtin>
      </rtps>
    </participant>
  </profiles>
</dds>
"""
