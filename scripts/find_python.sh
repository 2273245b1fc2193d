#!/bin/sh
# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Prints the Python for the environment: $PYTHON if it is set, else the first of python3.13, python3.12,
# python3.11 and python3 that runs, is supported and can create environments. Each is tested by running it, because a
# version manager leaves names that exist and fail. Without any it ends with one sentence and status 1.

set -u

if [ "$(uname -s) $(uname -m)" != "Linux x86_64" ]; then
    echo "cloth_sim_ros: the ROS 2 packages on PyPI are for x86-64 Linux and this is $(uname -s) on $(uname -m);" \
        "here cloth_sim_ros runs on an installed ROS 2 Jazzy (CONTRIBUTING.md, \"On a robot\")." >&2
    exit 1
fi

# Prints the interpreter itself (no shim, no link of an environment) or, with status 1, its fault.
probe='
import sys
version = ".".join(map(str, sys.version_info[:3]))
if not (3, 11) <= sys.version_info[:2] <= (3, 13):
    sys.exit(print("is Python " + version) or 1)
try:
    import ensurepip, venv
except ImportError:
    sys.exit(print("is Python " + version + " without venv") or 1)
print(sys._base_executable)
'

tried=""
for python in ${PYTHON:-python3.13 python3.12 python3.11 python3}; do
    command -v "$python" >/dev/null 2>&1 || continue
    if answer=$("$python" -c "$probe" 2>/dev/null); then
        echo "$answer"
        exit 0
    fi
    tried="$tried; $python ${answer:-does not run}"
done

if [ -n "${PYTHON:-}" ]; then
    tried="${tried:-; $PYTHON was not found}"
fi
echo "cloth_sim_ros: it needs Python 3.11, 3.12 or 3.13 with venv, and there is none${tried};" \
    "install one (Debian, Ubuntu: apt install python3 python3-venv), or name one: make PYTHON=/path/to/python3.12." >&2
exit 1
