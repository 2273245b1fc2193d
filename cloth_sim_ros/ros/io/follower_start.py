# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of obstacles: a robot's links at its pose, and obstacles that follow TF frames at their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer, Tf2MissingError
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

if TYPE_CHECKING:
    from cloth_sim_ros.ros.io.robot_start import RobotStart

#: End of the names of the parameters that name an obstacle's TF frame.
_FRAME_SUFFIX = ".frame"


class FollowerStart:
    """Start of obstacles that others place, once a node: `extend` waits for their poses and gives the scene these.

    So the cloth never starts with an obstacle elsewhere, and a reset without poses returns it to its start.

    Args:
        node: the node, which is in no executor yet.
        signal_name: returns the name of the signal that has come; empty if none has.
        robot: start of a robot's links; None without a robot.
    """

    def __init__(self, node: Node, signal_name: Callable[[], str], robot: RobotStart | None) -> None:
        self._node, self._signal_name, self._robot = node, signal_name, robot
        #: TF, if an obstacle or a robot needed it at the start.
        self.frames: FrameTransformer | None = None
        #: TF frame of each obstacle that started at it, by name.
        self.placed: dict[str, str] = {}

    def extend(self, values: Mapping[str, Any], files: Mapping[str, bytes]) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Wait, without limit, for a robot and TF frames; return parameters with obstacles at their poses, and files.

        Without tf2_ros obstacles start at their `position`.

        Raises:
            ParameterError: as `RobotStart.extend`, or if an obstacle follows a frame that this node publishes.
            StopRequestedError: if a signal came meanwhile.
        """
        extended, contents = dict(values), dict(files)
        if self._robot is not None:
            extended, contents = self._robot.extend(extended, contents)
            self.frames = self._robot.frames
        if not any(name.endswith(_FRAME_SUFFIX) and value for name, value in extended.items()):
            return extended, contents
        scene = Scene.from_parameters(extended, files=contents)
        frames = {name: scene.described[name].frame for name in scene.unlinked_names if scene.described[name].frame}
        present = {name: frame for name, frame in frames.items() if name in scene.obstacle_names}
        if self.frames is None:
            self.frames = FrameTransformer(self._node, scene.frame_id)
        # Obstacles that come later need the transforms of now.
        for frame in frames.values():
            self.frames.listen(frame)
        if present:
            self._refuse_published_frames(present, scene)
            extended |= self._await_poses(present, self.frames)
        return extended, contents

    @contextmanager
    def naming_frames(self) -> Iterator[None]:
        """Return a context that adds the frames of placed obstacles to a ValueError that names them.

        Raises:
            ValueError: the same, with a sentence more.
        """
        try:
            yield
        except ValueError as error:
            named = [
                f"'{name}' starts at TF frame '{frame}' ({name}{_FRAME_SUFFIX})"
                for name, frame in self.placed.items()
                if f"'{name}'" in str(error)
            ]
            if not named:
                raise
            raise ValueError("; ".join([str(error), *named])) from error

    def _refuse_published_frames(self, frames: Mapping[str, str], scene: Scene) -> None:
        prefix = f"{self._node.get_fully_qualified_name().strip('/')}/"
        for name, frame in frames.items():
            if scene.tf.publish and frame.startswith(prefix):
                raise ParameterError(
                    f"{name}{_FRAME_SUFFIX} is '{frame}', a frame that this node publishes once it runs (tf.publish); "
                    f"leave it out, and set it when the cloth runs"
                )

    def _await_poses(self, obstacles: Mapping[str, str], frames: FrameTransformer) -> dict[str, tuple[float, ...]]:
        """Wait for the frames of obstacles; return position and orientation by parameter, none without tf2_ros."""
        poses: dict[str, tuple[float, ...]] = {}
        reason = ""

        def find_poses() -> bool:
            nonlocal reason
            poses.clear()
            for name, frame in obstacles.items():
                try:
                    position, orientation, _ = frames.newest(frame)
                except Tf2MissingError:
                    return True
                except FrameError as error:
                    reason = f"'{name}' follows frame '{frame}': {error}"
                    return False
                poses.update({f"{name}.position": position, f"{name}.orientation": orientation})
            self.placed = dict(obstacles)
            return True

        from cloth_sim_ros.ros.io.start_wait import await_condition

        await_condition(
            self._node,
            find_poses,
            lambda: f"waiting for the TF frames of obstacles: {reason}",
            self._signal_name,
            on_jump_back=frames.clear,
        )
        return poses
