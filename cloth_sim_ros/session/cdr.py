# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CDR encoding (XCDR1) of the standard messages in a session.

Every ROS 2 middleware sends XCDR1. Alignment counts from the byte after the four-byte encapsulation header: a number of
n bytes starts at a multiple of n. Large messages (clouds, meshes) are read as numpy views of the given bytes, without
copying. All others go through rosbags' generic reader.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.session.channel_description import standard_types
from cloth_sim_ros.session.errors import SessionError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "Cloud",
    "MeshMessage",
    "decode",
    "decode_cloud",
    "decode_mesh",
    "decode_string",
    "encode",
    "encode_string",
    "message_class",
]

_LITTLE = b"\x00\x01\x00\x00"
#: Alignment to which a middleware may pad the end of a message [bytes].
_PADDING = 4
#: Size [bytes] of a number by its type in sensor_msgs/PointField: FLOAT32, FLOAT64.
_FIELD_SIZES = {7: 4, 8: 8}
_POSITION, _VELOCITY, _DEVIATION = ("x", "y", "z"), ("vx", "vy", "vz"), "deviation"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """Decoded sensor_msgs/PointCloud2: stamp [ns], size, and read-only views of the message's points."""

    stamp: int
    """Header stamp [ns]."""
    frame_id: str
    height: int
    width: int
    xyz: NDArray[np.floating]
    """Positions [m], shape (height * width, 3), read-only, float32 or float64 like the fields. Not contiguous if the
    cloud has further fields."""
    velocity: NDArray[np.floating] | None = None
    """Velocities [m/s], likewise; None if the cloud has no fields vx, vy, vz."""
    deviation: NDArray[np.floating] | None = None
    """Deviations [m], shape (height * width,), read-only; None if the cloud has no field deviation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshMessage:
    """Decoded shape_msgs/Mesh: particle indices (m, 3) and rest positions (n, 3) [m], views of the message's bytes."""

    triangles: NDArray[np.uint32]
    """Particle indices, shape (triangle_count, 3), read-only."""
    vertices: NDArray[np.float64]
    """Rest positions [m], shape (particle_count, 3), read-only."""


def decode(data: bytes | memoryview, type_name: str) -> Any:
    """Decode a standard ROS 2 message's CDR bytes into an object with its fields. Raises SessionError for other bytes.

    Args:
        data: CDR bytes.
        type_name: such as ``geometry_msgs/msg/PoseStamped``, of ROS 2 Jazzy's common interfaces.

    Returns:
        An object with the message's fields as attributes; arrays of numbers are numpy arrays.

    Raises:
        SessionError: if the bytes do not fit the type, or the type is unknown.
    """
    from rosbags.serde import SerdeError

    try:
        return standard_types().deserialize_cdr(data, type_name)
    except (SerdeError, KeyError) as error:
        raise SessionError(f"{len(data)} bytes are no {type_name}: {error}") from error


def encode(message: object, type_name: str) -> bytes:
    """Encode an instance of `message_class(type_name)` as CDR bytes (little-endian)."""
    return bytes(standard_types().serialize_cdr(message, type_name, little_endian=True))


def message_class(type_name: str) -> Any:
    """Return a message type's class, to construct with its fields for `encode`. Raises SessionError for unknown types.

    Raises:
        SessionError: for a type that is not in ROS 2 Jazzy's common interfaces.
    """
    try:
        return standard_types().types[type_name]
    except KeyError:
        raise SessionError(f"message type {type_name!r} is not a standard ROS 2 Jazzy type") from None


def encode_string(text: str) -> bytes:
    """Encode a std_msgs/String as CDR bytes."""
    raw = text.encode()
    return b"".join((_LITTLE, struct.pack("<I", len(raw) + 1), raw, b"\x00"))


def decode_string(data: bytes | memoryview) -> str:
    """Return the text of a std_msgs/String. Raises SessionError if the bytes are not one."""
    reader = _CdrReader(data, "std_msgs/msg/String")
    text = reader.string()
    reader.end()
    return text


def decode_cloud(data: bytes | memoryview) -> Cloud:
    """Decode a PointCloud2 into a `Cloud`, whose arrays are read-only views of `data`.

    Raises:
        SessionError: if it is cut off, or x, y, z are not evenly spaced numbers of float32 or float64.
    """
    reader = _CdrReader(data, "sensor_msgs/msg/PointCloud2")
    seconds, nanoseconds = reader.numbers("iI")
    frame_id = reader.string()
    height, width, field_count = reader.numbers("III")
    fields: dict[str, tuple[int, int]] = {}
    for _ in range(field_count):
        name = reader.string()
        (offset,) = reader.numbers("I")
        (datatype,) = reader.numbers("B")
        (count,) = reader.numbers("I")
        if datatype in _FIELD_SIZES and count == 1:
            fields[name] = offset, _FIELD_SIZES[datatype]
    (big_endian,) = reader.numbers("B")
    point_step, row_step = reader.numbers("II")
    (size,) = reader.numbers("I")
    start = reader.skip(size)
    if not _are_evenly_spaced(fields, _POSITION):
        raise SessionError("a cloud has no evenly spaced fields x, y, z of one type, float32 or float64")
    end = max(offset + length for offset, length in fields.values())
    if height * row_step > size or width * point_step > row_step or end > point_step:
        raise SessionError(f"a cloud of {height} x {width} points of {point_step} bytes does not fit its {size} bytes")

    def view(*names: str) -> NDArray[np.floating]:
        offset, length = fields[names[0]]
        if not height * width:
            # No offset of a field has to lie within the bytes.
            return np.empty((0, len(names)), dtype=f"f{length}")
        points = np.ndarray(
            (height, width, len(names)),
            dtype=f"{'>' if big_endian else '<'}f{length}",
            buffer=data,
            offset=start + offset,
            strides=(row_step, point_step, fields[names[min(1, len(names) - 1)]][0] - offset),
        )
        points.flags.writeable = False
        return points.reshape(height * width, len(names))

    return Cloud(
        stamp=seconds * 1_000_000_000 + nanoseconds,
        frame_id=frame_id,
        height=height,
        width=width,
        xyz=view(*_POSITION),
        velocity=view(*_VELOCITY) if _are_evenly_spaced(fields, _VELOCITY) else None,
        deviation=view(_DEVIATION)[:, 0] if _DEVIATION in fields else None,
    )


def _are_evenly_spaced(fields: Mapping[str, tuple[int, int]], names: tuple[str, str, str]) -> bool:
    """Return True if three fields exist, of one size, equally spaced. `fields`: offset and size [bytes] by name."""
    if not fields.keys() >= set(names):
        return False
    (first, first_length), (second, second_length), (third, third_length) = (fields[name] for name in names)
    return second - first == third - second and first_length == second_length == third_length


def decode_mesh(data: bytes | memoryview) -> MeshMessage:
    """Decode a shape_msgs/Mesh into a `MeshMessage`, views of `data`. Raises SessionError if the bytes are not one."""
    reader = _CdrReader(data, "shape_msgs/msg/Mesh")
    (triangle_count,) = reader.numbers("I")
    triangles = reader.array("<u4", triangle_count * 3)
    (vertex_count,) = reader.numbers("I")
    vertices = reader.array("<f8", vertex_count * 3)
    return MeshMessage(triangles=triangles.reshape(-1, 3), vertices=vertices.reshape(-1, 3))


class _CdrReader:
    """Cursor over CDR bytes that aligns numbers; raises SessionError at the end instead of reading past it."""

    __slots__ = ("_data", "_order", "_position", "_type_name")

    def __init__(self, data: bytes | memoryview, type_name: str) -> None:
        self._data = data
        self._type_name = type_name
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise SessionError(f"{len(data)} bytes are no {type_name}: no plain CDR header")
        self._order = "<" if data[1] else ">"
        self._position = 4

    def numbers(self, codes: str) -> tuple[int, ...]:
        """Read numbers of one size, aligned, and advance. `codes`: struct codes, e.g. "II". Raises SessionError."""
        size = struct.calcsize("=" + codes[0])
        start = self._align(size)
        end = start + size * len(codes)
        self._check(end)
        self._position = end
        return struct.unpack_from(self._order + codes, self._data, start)

    def string(self) -> str:
        (length,) = self.numbers("I")
        start = self.skip(length)
        if length and self._data[start + length - 1]:
            raise SessionError(f"{len(self._data)} bytes are no {self._type_name}: a text lacks its end")
        try:
            return str(bytes(self._data[start : start + max(length - 1, 0)]), "utf-8")
        except UnicodeDecodeError as error:
            raise SessionError(f"a {self._type_name} holds a text that is not UTF-8: {error}") from error

    def end(self) -> None:
        """Raise SessionError if more than padding follows."""
        n_bytes = len(self._data) - self._position
        if n_bytes >= _PADDING:
            raise SessionError(f"{len(self._data)} bytes are no {self._type_name}: {n_bytes} bytes follow its end")

    def skip(self, size: int) -> int:
        """Skip `size` bytes; return the offset of the first one. Raises SessionError beyond the end."""
        start = self._position
        self._check(start + size)
        self._position = start + size
        return start

    def array(self, dtype: str, count: int) -> NDArray[Any]:
        """Read `count` numbers of a numpy dtype as a read-only view, and advance. Raises SessionError at the end."""
        kind = np.dtype(dtype if self._order == "<" else ">" + dtype[1:])
        if count:
            self._align(kind.itemsize)
        start = self.skip(count * kind.itemsize)
        view = np.frombuffer(self._data, kind, count, start) if count else np.empty(0, kind)
        view.flags.writeable = False
        return view

    def _align(self, size: int) -> int:
        self._position += -(self._position - 4) % size
        return self._position

    def _check(self, end: int) -> None:
        if end > len(self._data):
            raise SessionError(f"{len(self._data)} bytes are no {self._type_name}: it ends at byte {end} or later")
