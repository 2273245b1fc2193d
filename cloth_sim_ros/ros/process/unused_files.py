# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings of parameter files that set nothing for the node."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

_OPTIONS = ("--params-file",)


def unused_files(arguments: Sequence[str], *, node: str) -> Iterator[str]:
    """Yield a sentence for each parameter file that only holds parameters of other nodes.

    Args:
        arguments: the command line.
        node: full name of the node, after remapping.
    """
    for option, path in pairwise(arguments):
        # ROS has read a pipe already.
        if option not in _OPTIONS or not Path(path).is_file():
            continue
        try:
            owners = parameter_file.other_nodes(parameter_file.text_of(path), node=node, source=path)
        except ParameterError:
            # ROS has accepted the file: the two readers differ in what they refuse.
            continue
        if owners:
            yield f"'{path}' sets nothing for the node {node}: {owners.partition(', or give the name')[0]}"
