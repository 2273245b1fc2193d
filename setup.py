# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Installation of cloth_sim_ros with pip or colcon."""

import os
import runpy
from glob import glob
from pathlib import Path
from types import SimpleNamespace

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # setuptools before 70.1, as Ubuntu 24.04 has; colcon makes no wheels
    bdist_wheel = None

NAME = "cloth_sim_ros"
ENGINE = f"{NAME}.engine"

# colcon takes no build requirements: nothing but setuptools and the standard library is there. The file is run, not
# imported, because the package can't be before it is installed.
engine = SimpleNamespace(**runpy.run_path(str(Path(__file__).absolute().parent / NAME / "engine" / "build.py")))


class BuildEngine(build_ext):
    """Builds the engine's libraries, which are called through ctypes and need no headers of Python's."""

    def get_ext_filename(self, fullname):
        """The plain name: a library is the same for every Python."""
        return os.path.join(*fullname.split(".")) + ".so"

    def run(self):
        """All into the build folder, or this machine's beside the sources where the package is used in place."""
        names = None
        if self.inplace:
            folder = self.get_finalized_command("build_py").get_package_dir(ENGINE)
            names = engine.names_here()[:1]
        else:
            folder = os.path.join(self.build_lib, *ENGINE.split("."))
        try:
            engine.build(
                Path(folder).absolute(), names=names, on_message=lambda text: self.announce(f"{NAME}: {text}", level=2)
            )
        except engine.BuildError as error:
            raise SystemExit(str(error)) from None


commands = {"build_ext": BuildEngine}
if bdist_wheel is not None:

    class AnyPythonWheel(bdist_wheel):
        """The libraries use no interface of Python's: one wheel serves every Python of a platform."""

        def get_tag(self):
            """Any Python 3, the platform of the libraries."""
            return "py3", "none", super().get_tag()[2]

    commands["bdist_wheel"] = AnyPythonWheel


def extensions():
    """One for each library of this machine, so that setuptools knows that there is something to build."""
    try:
        names = engine.names_for()
    except engine.BuildError as error:
        raise SystemExit(str(error)) from None
    sources = [os.path.relpath(path, Path(__file__).absolute().parent) for path in engine.translation_units()]
    return [Extension(f"{ENGINE}.{Path(engine.file_name(name)).stem}", sources=sources) for name in names]


# The core runs the physics and the simulation. What needs a ROS graph, writes or shows sessions, reads mesh files or
# measures is an extra of its own, so that `import cloth_sim_ros` needs none of it. Lower bounds are those of Ubuntu
# 24.04, so that the same code runs on a robot's own packages; constraints.txt pins what `make` installs.
CORE = ["numpy>=1.26", "scipy>=1.11", "attrs>=23.2", "PyYAML>=6.0", "xxhash>=3.2", "tqdm>=4.66"]

SESSION = ["mcap>=1.1", "rosbags>=0.10.8", "zstandard>=0.22", "lz4>=4.0"]

EXTRAS = {
    # Always the names with the distribution in them: the bare ones also carry later distributions. The wheels are for
    # x86-64 Linux; with an installed ROS 2 this extra is not wanted.
    "ros": ["ros-jazzy-rclpy[fastrtps]>=7.1.6", "ros-jazzy-common-interfaces>=5.3.6"],
    "record": SESSION,
    "replay": [*SESSION, "rerun-sdk>=0.41,<0.42"],
    # Trajectories as Parquet.
    "export": ["pyarrow>=18.0"],
    # plyfile is under GPL-3.0-or-later, not Apache-2.0 as this package: it is imported only for PLY files that are text
    # or have rows of several lengths, and nothing else needs it.
    "mesh": ["trimesh>=4.0", "plyfile>=1.0.3"],
    # Studies on Dask (bokeh draws its dashboard), environments of gymnasium, datasets as zarr and Parquet with video.
    "batch": [
        *SESSION,
        "distributed>=2025.1",
        # Makes the certificates of the cluster that a study starts.
        "cryptography>=41.0",
        # Processes that outlive a call, and need no `if __name__ == "__main__"` in a user's program.
        "loky>=3.4",
        "bokeh>=3.4",
        "gymnasium>=1.1",
        "zarr>=3.0",
        "pyarrow>=18.0",
        "av>=14.0",
        "matplotlib>=3.8",
    ],
    # For `make bench` and `make validate` in a clone.
    "bench": ["matplotlib>=3.8", "scikit-sundae>=1.1", "threadpoolctl>=3.1", "psutil>=5.9"],
    # The site, built as rosdoc2 builds it.
    "docs": ["sphinx>=7.2", "myst-parser>=2.0", "sphinx-rtd-theme>=2.0"],
    # ipctk tells whether a surface passes through itself; it has wheels for x86-64 Linux.
    "test": [
        "pytest>=7.4",
        "pytest-timeout>=2.2",
        "pytest-xdist>=3.5",
        "hypothesis>=6.98",
        "psutil>=5.9",
        'ipctk>=1.4; platform_machine == "x86_64"',
        # The other simulator of examples/mujoco_arm.py.
        "mujoco>=3.3",
    ],
}
# What `make run` installs, and what `make test`, `make check` and `make docs` install.
EXTRAS["demo"] = [*EXTRAS["ros"], *EXTRAS["record"], *EXTRAS["replay"]]
EXTRAS["dev"] = [
    *EXTRAS["demo"],
    *EXTRAS["export"],
    *EXTRAS["mesh"],
    *EXTRAS["batch"],
    *EXTRAS["bench"],
    *EXTRAS["docs"],
    *EXTRAS["test"],
    # Another version would format otherwise.
    "clang-format==23.1.5",
    # Another version would have other checks.
    "clang-tidy==23.1.4",
    "ruff>=0.17",
    "mypy>=2.0",
    "types-PyYAML",
    "catkin_pkg>=1.0",
    # What the documented commands need: --packages-select, setup.bash, test-result.
    "colcon-core",
    "colcon-bash",
    "colcon-package-selection",
    "colcon-python-setup-py",
    "colcon-ros",
    "colcon-test-result",
]

setup(
    name=NAME,
    version="0.2.0",
    description="A live mass-spring cloth in a ROS 2 graph: grasped through topics, recorded, replayed, re-run exactly",
    author="cloth_sim_ros authors",
    author_email="cloth_sim_ros@example.org",
    maintainer="cloth_sim_ros authors",
    maintainer_email="cloth_sim_ros@example.org",
    license="Apache-2.0",
    python_requires=">=3.11,<3.14",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # Files beside the code that are not Python: the sources of the engine, and the fabrics.
    package_data={ENGINE: list(engine.PATTERNS), f"{NAME}.scene": ["fabrics.yaml"]},
    ext_modules=extensions(),
    cmdclass=commands,
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*"))),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    install_requires=CORE,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "cloth_sim = cloth_sim_ros.ros.main:main",
            "cloth_gripper = cloth_sim_ros.ros.gripper_main:main",
            "cloth_viewer = cloth_sim_ros.ros.viewer_main:main",
            "cloth_replay = cloth_sim_ros.replay.command:main",
            "cloth_verify = cloth_sim_ros.verify.command:main",
            "cloth_batch = cloth_sim_ros.studies.command:main",
            "cloth_session = cloth_sim_ros.session.command:main",
            "cloth_fit = cloth_sim_ros.fit.command:main",
            "cloth_drape = cloth_sim_ros.laboratory.drape_command:main",
            "cloth_lab = cloth_sim_ros.laboratory.lab_command:main",
            "cloth_bench = cloth_sim_ros.session.moved_bench:main",
        ],
    },
)
