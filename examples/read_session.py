# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Content of a recorded session: `python read_session.py session.mcap`. Needs no ROS."""

import sys

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.reader import SessionReader, session_files


def main() -> None:
    """Print one line per second of simulated time, and the events."""
    with SessionReader(session_files(sys.argv[1])) as session:
        print(f"recorded by cloth_sim_ros {session.metadata['version']}, node {session.node}")
        due = 0.0
        for recorded in session.clouds():
            frame = recorded.frame
            if frame is None:
                continue
            for event in frame.events:
                if event["kind"] != "target":
                    print(f"{frame.time:7.3f} s  {event}")
            if frame.time >= due:
                due += 1.0
                low = recorded.cloud.xyz[:, 2].min()  # (n, 3) [m]
                print(f"{frame.time:7.3f} s  {frame.steps} steps, lowest point {low:.3f} m, digest {frame.digest}")
        if session.missing:
            print(f"missing: {session.missing}")


if __name__ == "__main__":
    try:
        main()
    except (IndexError, SessionError) as error:
        raise SystemExit(f"usage: read_session.py session.mcap; {error}") from error
